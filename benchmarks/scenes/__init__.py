"""What a finished scene costs to use."""
