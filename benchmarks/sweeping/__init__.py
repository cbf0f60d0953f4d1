"""What one or two settings do to the error, and which settings reach a wanted one."""
