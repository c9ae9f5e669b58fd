"""Builds in a new folder: setuptools packs what an earlier build left in build/, too."""

import tempfile

from setuptools import setup

build = tempfile.TemporaryDirectory()
setup(options={'build': {'build_base': build.name}})
