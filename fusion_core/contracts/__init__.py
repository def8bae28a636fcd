"""The contracts of the plugin families, one file each; the public names stand in the stub, `__init__.pyi`."""

from fusion_core import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
