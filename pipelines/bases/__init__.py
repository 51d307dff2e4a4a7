"""The knowledge that a sequence of scenes hands on."""
