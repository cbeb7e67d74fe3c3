"""The command line: ``hyperpaint`` or ``python -m hyperpaint``, one file a command.

Words come in, workflows are called, sentences and exit states go out. Nothing imports it.
"""
