"""Commands on finished scenes, and on teachers."""
