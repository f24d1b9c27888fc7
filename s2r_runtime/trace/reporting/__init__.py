"""The result: as JSON, text and figures."""
