"""Equations as MathML, which browsers draw without scripts and fonts from elsewhere."""

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

_LOGGER = logging.getLogger(__name__)
# latex2mathml lays out `split`, and leaves the others as they are.
_ALIGNED = re.compile(r"\\(begin|end)\{(?:aligned|align|align\*|eqnarray|eqnarray\*)\}")
_PLAIN = re.compile(r"\\(?:begin|end)\{(?:equation|equation\*|gather|gather\*|gathered)\}|\\label\{[^}]*\}")


def to_mathml(latex: str, *, display: str = "inline") -> str:
    """MathML of one equation.

    Raises:
        ValueError: A command is unknown, or braces do not match.
    """
    latex = _PLAIN.sub("", _ALIGNED.sub(r"\\\1{split}", latex)).strip()
    if latex.count("{") - latex.count(r"\{") != latex.count("}") - latex.count(r"\}"):
        raise ValueError(f"braces must match, got {latex!r}")
    found = convert(latex, display=display)
    unknown = re.findall(r"\\[A-Za-z]+", found)
    if unknown:
        raise ValueError(f"commands must be known to latex2mathml, got {', '.join(unknown)} in {latex!r}")
    return found


def _visit(translator, node: nodes.Element, display: str) -> None:
    try:
        translator.body.append(to_mathml(node.astext(), display=display))
    except Exception as error:
        _LOGGER.warning("no MathML of an equation: %s", error, location=node)
    raise nodes.SkipNode


def visit_inline(translator, node: nodes.Element) -> None:
    """Writes an equation within a line."""
    _visit(translator, node, "inline")


def visit_block(translator, node: nodes.Element) -> None:
    """Writes an equation of its own, with its number where it has one."""
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    names = "".join(f' id="{name}"' for name in node.get("ids", [])[:1])
    translator.body.append(f'<div class="equation"{names}>{number}')
    try:
        translator.body.append(to_mathml(node.astext(), display="block"))
    except Exception as error:
        _LOGGER.warning("no MathML of an equation: %s", error, location=node)
    translator.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict:
    """Registers the renderer `mathml`."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
