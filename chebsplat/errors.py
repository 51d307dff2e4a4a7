"""Typed errors and their process exit codes; the one module that every layer may import."""


class ChebsplatError(Exception):
    """Base of every error whose message is meant for the user."""

    exit_code = 1


class ConfigError(ChebsplatError):
    """A configuration or a command line that cannot be used."""

    exit_code = 2


class InputError(ChebsplatError):
    """An input that is missing, damaged or of a wrong schema; the message names file and remedy."""

    exit_code = 3


class DataFailure(ChebsplatError):
    """Well-formed data that the method cannot work with, or a numerical failure."""

    exit_code = 4


class DiskFailure(ChebsplatError):
    """A disk that is full or may not be written; the message names file, bytes and remedy."""

    exit_code = 4


class Stopped(BaseException):
    """The process was asked to end; no `except Exception` takes it for a failure."""

    def __init__(self, number: int, reason: str):
        super().__init__(reason)
        self.exit_code = 128 + number  # as shells give it: 130 for SIGINT, 143 for SIGTERM
