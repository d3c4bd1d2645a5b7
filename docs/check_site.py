"""
Check a built site without a network: every internal link, anchor, image and script exists, no page loads from elsewhere, and
every figure for plotly.js is data that a browser reads and has the one file of plotly.js on its page.

`python docs/check_site.py FOLDER` prints what is wrong, and exits with status 1 if anything is.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# What a browser loads with the page, by the attribute that names it
LOADED = {"img": "src", "script": "src", "source": "src", "video": "src", "iframe": "src", "link": "href"}


class Page(HTMLParser):
    """
    The anchors of a page, the addresses that it links to and loads, and its figures.

    :param path: the page's file
    """

    def __init__(self, path: Path):
        super().__init__()
        self.anchors = {""}
        self.linked: list[str] = []
        self.loaded: list[str] = []
        self.figures: list[str] = []
        self.data: dict[str, str] = {}
        self.reading: str | None = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """
        Note the anchor of an element, and the address that it links to or loads.

        :param tag: the element's name, in lower case
        :param attrs: its attributes by name; the value of an attribute without one is None
        """
        attributes = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := attributes.get(name))}
        if tag == "a" and (address := attributes.get("href")):
            self.linked.append(address)
        if tag in LOADED and (address := attributes.get(LOADED[tag])):
            self.loaded.append(address)
        if figure := attributes.get("data-figure"):
            self.figures.append(figure)
        self.reading = attributes.get("id") if attributes.get("type") == "application/json" else None

    def handle_data(self, data: str) -> None:
        """
        Keep the data of a figure.

        :param data: text between two tags, or a part of it
        """
        if self.reading is not None:
            self.data[self.reading] = self.data.get(self.reading, "") + data

    def handle_endtag(self, tag: str) -> None:
        """
        End the data of a figure.

        :param tag: the name of the element that ends, in lower case
        """
        self.reading = None


def find_figure_faults(page: Page) -> Iterator[str]:
    """
    Yield a line for every fault of a page's figures.

    :param page: the page
    :return: the lines
    """
    for figure in page.figures:
        try:
            has_curves = bool(json.loads(page.data.get(figure, ""))["data"])
        except (ValueError, KeyError):
            has_curves = False
        if not has_curves:
            yield f"{figure}: no data"
    scripts = [address for address in page.loaded if "plotly" in address]
    if page.figures and len(scripts) != 1:
        yield f"loads plotly.js {len(scripts)} times"


def find_faults(folder: Path) -> Iterator[str]:
    """
    Yield a line for every fault of the site.

    :param folder: the folder of the built site
    :return: the lines
    """
    pages = {path.resolve(): Page(path) for path in sorted(folder.rglob("*.html"))}
    if not pages:
        yield f"{folder}: no page"
    for path, page in pages.items():
        name = path.relative_to(folder.resolve())
        yield from (f"{name}: loads {address} from a network" for address in page.loaded if is_external(address))
        yield from (f"{name}: {fault}" for fault in find_figure_faults(page))
        for address in page.linked + page.loaded:
            if not is_external(address) and (fault := find_fault(path, address, pages)):
                yield f"{name}: {address}: {fault}"


def is_external(address: str) -> bool:
    """
    Return whether an address has a scheme or a host, so that it is not a file of the site; data within the page is none.

    :param address: the address
    :return: whether it is external
    """
    parts = urlsplit(address)
    return parts.scheme != "data" and bool(parts.scheme or parts.netloc)


def find_fault(path: Path, address: str, pages: dict[Path, Page]) -> str | None:
    """
    Return what is wrong with an internal address, or None.

    :param path: the page that has the address
    :param address: a link, relative to the page
    :param pages: all pages of the site, by their files
    :return: the fault, if there is one
    """
    parts = urlsplit(address)
    if parts.scheme == "data":
        return None
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not target.is_file():
        return "no such file"
    if target in pages and unquote(parts.fragment) not in pages[target].anchors:
        return "no such anchor"
    return None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    faults = list(find_faults(parser.parse_args().folder))
    print("".join(f"{fault}\n" for fault in faults), end="")
    sys.exit(bool(faults))
