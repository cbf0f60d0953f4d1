"""Readers of what microscopes write: one vendor a file, all through `base.compose`, which lets nothing absurd pass."""
