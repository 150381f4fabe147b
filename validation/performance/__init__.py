"""Memory and time of reading and of diagnosing campaigns of large sensors."""
