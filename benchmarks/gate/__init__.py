"""The regression gate: accuracy and speed that were committed to, and what says in one sentence that they moved."""
