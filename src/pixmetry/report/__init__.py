"""The page kit: a page is a tree of sections, text, tables, figures and findings; HTML and PDF are made of the same tree.

Records of numbers enter; HTML, SVG and PDF leave. What a page says is decided in the room of its job (``page_of``).
"""

from pixmetry.report.html import html_of, write_html
from pixmetry.report.page import Answer, Column, Facts, Figure, Page, Points, Reading, Row, Run, Section, Table, Text, strong
from pixmetry.report.pdf import pdf_of, write_pdf

__all__ = [
    "Answer",
    "Column",
    "Facts",
    "Figure",
    "Page",
    "Points",
    "Reading",
    "Row",
    "Run",
    "Section",
    "Table",
    "Text",
    "html_of",
    "pdf_of",
    "strong",
    "write_html",
    "write_pdf",
]
