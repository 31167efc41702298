"""Records turned into files that other programs read: one file here per format, `FORMATS` lists them."""

from testbed.exports.registry import FORMATS, export

__all__ = ["FORMATS", "export"]
