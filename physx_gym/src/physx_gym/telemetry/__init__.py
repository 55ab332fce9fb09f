"""Recording of episodes and log files."""
