"""Where a capture can come from: one module for each kind of source."""
