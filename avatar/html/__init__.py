"""Self-contained HTML pages: everything is escaped, images are inside the file, nothing is fetched.

page = document("Title", [element("p", "a < b"), picture(image, "caption")])
"""

from avatar.html.document import Markup, document, element, join
from avatar.html.parts import data_table, figure_of, fold, picture, plot, section, tiles

__all__ = [
    "Markup",
    "data_table",
    "document",
    "element",
    "figure_of",
    "fold",
    "join",
    "picture",
    "plot",
    "section",
    "tiles",
]
