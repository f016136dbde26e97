"""Pure rules: jobs, the queue, machine state, programs and reports. No module here does I/O."""
