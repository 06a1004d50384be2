"""The packages, one of which lies elsewhere; all else stands in setup.cfg."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["pp_cl*", "pp_studio*"]), "pp_cl.cl"])
