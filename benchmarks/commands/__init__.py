"""Commands of the bench, one file each; everything slow is imported inside the function that needs it."""
