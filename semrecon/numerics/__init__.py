"""Tools that several stages share: rigid motions, robust fits, neighbours, normal equations."""
