"""What a baseline and effects predict of every channel."""
