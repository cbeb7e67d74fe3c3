"""The command line: ``hyperpaint`` or ``python -m hyperpaint``, few files of commands.

Words come in, workflows are called, sentences and exit states go out. Nothing imports it.
"""
