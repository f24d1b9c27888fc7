"""What is believed, and why: canonical bytes, keys, certificates, revocations and the offline ledger."""
