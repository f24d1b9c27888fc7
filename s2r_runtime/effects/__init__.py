"""Effects that a model can lack, one file each, registered through the public hook."""
