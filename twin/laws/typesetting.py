"""The law of an effect as HTML, for pages."""

import html
import re

from markupsafe import Markup

SYMBOL = r"\b([A-Z][cy]|[kcmw][0-9hb]|kc|cu|uy)\b"  # Fc, Fy, k3, ch: a letter with its index


def typeset_law(term: str) -> Markup:
    """Return the term of an effect as HTML: indices, powers, primes and minus signs."""
    text = html.escape(term, quote=False)
    text = re.sub(r"\b([A-Za-z])_([A-Za-z0-9]+)", r"\1<sub>\2</sub>", text)
    text = re.sub(SYMBOL, lambda match: f"{match[1][0]}<sub>{match[1][1:]}</sub>", text)
    text = re.sub(r"\^(?:\(([0-9/]+)\)|([0-9]+))", r"<sup>\1\2</sup>", text)
    text = re.sub(r"\babs\(([^()]*)\)", r"|\1|", text)
    text = re.sub(r"(?<![A-Za-z0-9])-(?=[A-Za-z(])", "−", text)
    return Markup(text.replace("'", "′").replace(" x ", " × "))
