"""The one kind of error that is a user's to mend."""


class InputError(Exception):
    """A mistake in what the user gave: file, option or data.

    The message is one line that names the file or option, the rule it breaks and the remedy; tools print it and exit
    with code 2.
    """
