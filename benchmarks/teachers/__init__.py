"""What teaching knowledge takes, and how far views agree."""
