"""Links from the documentation to files of the repository lead to the repository's page on the site."""

import posixpath
import re

_IMAGE_SUFFIXES = (".jpg", ".png")
_LINK = re.compile(r"(\]\()(\.\./[^)#\s]+)")


def on_page_markdown(markdown, page, config, files):
    """Replace relative links that leave ``docs/``."""
    repository = config.repo_url.rstrip("/")

    def absolute(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page.file.src_uri), match[2]))
        return f"{match[1]}{repository}/{'raw' if path.endswith(_IMAGE_SUFFIXES) else 'blob'}/main/{path}"

    return _LINK.sub(absolute, markdown)
