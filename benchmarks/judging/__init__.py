"""An answer against truth, and against the physical limit."""
