"""Methods of reconstruction: one file a method, all with the call of `base.Method`."""
