"""Settings for all tests."""

from hypothesis import settings

# How long an example takes says nothing here: kernels compile, and the machine may be busy.
settings.register_profile("bnirl_ros", deadline=None)
settings.load_profile("bnirl_ros")
