"""Views of the record: leaderboards, the HTML report, error maps, the page on methods."""
