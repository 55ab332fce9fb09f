"""Transport: environments in processes of their own, spoken to over TCP."""
