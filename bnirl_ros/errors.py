"""The one exception that stands for a user's mistake rather than ours."""


class InputError(ValueError):
    """Bad input: a file, topic, message or setting that cannot be used.

    The message is one sentence for the user: it names the file or topic, says what is wrong and
    what to do. Commands print it without a traceback and end with status 1; nodes log and count
    it and go on.
    """
