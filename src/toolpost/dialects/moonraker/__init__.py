"""Moonraker's API (moonraker_job_queue.md): one table of methods over HTTP, JSON-RPC and sockets."""
