"""Pictures, videos and web pages of robots, and the page on which one drives them."""
