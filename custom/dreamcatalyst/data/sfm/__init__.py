"""Structure from motion: the cameras of photographs or of a video, kept between runs."""
