"""The mark of tests that use an extension: the core's tests run without them."""

import importlib.util

import pytest

with_extensions = pytest.mark.skipif(importlib.util.find_spec("neuspring.extensions") is None, reason="it is about an extension")
