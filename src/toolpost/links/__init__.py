"""Links: how bytes get to a machine and back. A link knows nothing of what they mean."""
