"""Looking at a run while it goes on, or afterwards: processes of their own that read the log and are never waited for."""
