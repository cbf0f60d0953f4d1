"""The bench: the only place that imports both semsim and semrecon."""
