"""The HTTP server: listeners, who may come in, and how much they may send. It knows no dialect."""
