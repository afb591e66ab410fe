"""What differs between tasks, and nothing else: one file a task, one value the rest asks."""
