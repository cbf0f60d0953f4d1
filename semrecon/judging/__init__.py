"""Measures of an answer against truth: gauges, errors, their split."""
