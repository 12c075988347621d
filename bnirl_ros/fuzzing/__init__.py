"""Bad input for every door of the package: what nobody should send, and somebody will.

`python -m bnirl_ros.fuzzing`, or `make campaigns`. A door takes bytes. It may accept
them, or refuse them with an `InputError`; anything else is a fault, and so is to take too long or
too much memory.
"""
