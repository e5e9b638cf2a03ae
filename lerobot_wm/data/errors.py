"""What is wrong with a dataset, in one line."""


class DatasetError(ValueError):
    """A dataset that cannot be used; its text is one line: the file, what is wrong with it, and how to mend it."""
