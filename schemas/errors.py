"""The errors clipmap raises on purpose; each message is one sentence that says what, where and what to do."""


class ClipmapError(Exception):
    """Base of every error that clipmap raises on purpose; its text is meant for the user."""


class UsageError(ClipmapError):
    """The request contradicts itself or the dataset: unknown codec, wrong layer kind, missing option."""


class InputError(ClipmapError):
    """A source or a dataset is not what it claims to be: unreadable, truncated, unsupported, damaged."""


class NotFoundError(ClipmapError):
    """A named thing does not exist: dataset, layer, level, or a block outside the lattice."""


class StorageError(ClipmapError):
    """Reading from or writing to a store failed: permission, full disk, lock held by another build."""


class MissingExtraError(ClipmapError):
    """An optional dependency is not installed; the message names the extra that brings it."""
