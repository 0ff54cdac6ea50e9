"""What is a user's to mend: errors, and warnings where the work can go on."""


class InputError(Exception):
    """A mistake in what the user gave: file, option or data.

    The message is one line that names the file or option, the rule it breaks and the remedy; tools print it and exit
    with code 2.
    """


class InputWarning(UserWarning):
    """Something that the user gave cannot be used, and the work goes on without it; tools print it as one line."""
