"""Methods that fit and edit, density control, and the systems that run them."""
