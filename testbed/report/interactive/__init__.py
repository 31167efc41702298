"""The part of a page that can be looked around in: Python says what, and the scripts in `static` draw it with BokehJS.

What is shown is plain data, made by `contents`. Bokeh's models are not made in Python, which would take as long as to
draw all figures; a page makes each plot when it comes into sight.
"""

from testbed.report.interactive.arrays import Arrays
from testbed.report.interactive.contents import Shown, contents, over_time
from testbed.report.interactive.embed import script, styles

__all__ = ["Arrays", "Shown", "contents", "over_time", "script", "styles"]
