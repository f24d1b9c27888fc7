"""Pages: what a log shows, what a trace found."""
