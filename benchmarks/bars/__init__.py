"""Bars: what the dense method is to keep, each measured on specimens that nobody tuned on."""
