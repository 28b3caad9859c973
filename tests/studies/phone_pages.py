"""Pages on a phone: every page below some folders at 420 px, light and dark, none wider.

python -m tests.studies.phone_pages FOLDER... [--pictures FOLDER]
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.monitor.browser import open_browser

WIDTH_PX = 420


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    pages = sorted(page for folder in options.folders for page in folder.rglob("*.html"))
    wide = faulty = 0
    with TemporaryDirectory() as name, open_browser(Path(name)) as browser:
        for dark in (False, True):
            for page in pages:
                browser.console.clear()
                browser.open(page.resolve().as_uri(), width=WIDTH_PX, dark=dark)
                width = browser.evaluate("document.documentElement.scrollWidth")
                if width > WIDTH_PX or browser.console:
                    print(f"{page}, {'dark' if dark else 'light'}: {width} px", *browser.console)
                wide, faulty = wide + (width > WIDTH_PX), faulty + bool(browser.console)
                if options.pictures:
                    scheme = "dark" if dark else "light"
                    picture = f"{page.parent.name}-{page.stem}-{scheme}.png"
                    browser.take_screenshot(options.pictures / picture)
    print(f"{2 * len(pages)} views, {wide} wider than {WIDTH_PX} px, {faulty} with errors")


if __name__ == "__main__":
    main()
