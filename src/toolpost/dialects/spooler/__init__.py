"""The spooler's API (spark_spooler.md): nine calls, each a POST with JSON in and out."""
