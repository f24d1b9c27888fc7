"""CAN transport."""
