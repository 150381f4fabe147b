"""Claims and how they were checked: one notebook or command per claim, results beside."""
