"""Pages in HTML: the report of one gain file, and the comparison of several.

    analyse (analysis.py) -> sections of tables and figures (sections.py, report.py) -> render (document.py)

A page is one file: the style stands in it, figures are inline SVG, and nothing is loaded from elsewhere.
"""
