"""Controls cameras through the interface ``base.Driver``, with one module for each kind of camera."""
