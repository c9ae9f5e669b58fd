"""Builds in a new folder: setuptools packs what an earlier build left in build/, too."""

import tempfile

from setuptools import setup
from setuptools.command.build_py import build_py


class DataOnly(build_py):
    """Leaves out this file: the package has no modules."""

    def find_package_modules(self, package, package_dir):
        return []


build = tempfile.TemporaryDirectory()
setup(options={'build': {'build_base': build.name}}, cmdclass={'build_py': DataOnly})
