"""Controllers: loaded and digested as bytes, run confined in a process of their own."""
