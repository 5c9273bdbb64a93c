"""What this site does beyond its plugins: formulas as MathML, pages made of files elsewhere in the
repository, and short names in cross references."""

import base64
import itertools
import json
import re
from html import unescape
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.blockprocessors import BlockProcessor
from markdown.extensions.toc import slugify
from markdown.inlinepatterns import InlineProcessor
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files


ROOT = Path(__file__).parents[1]
PAGES = {"benchmarks.md": ROOT / "benchmarks" / "README.md", "changes.md": ROOT / "CHANGELOG.md"}
# Folders that are copied, and which files of them.
FOLDERS = {
    "notebooks": (ROOT / "notebooks", ("*.ipynb",)),
    "results": (ROOT / "benchmarks" / "results", ("**/*.png", "**/*.json", "**/*.gif")),
}
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#]+)\)")
_PAGE = re.compile(r'href="\.\./docs/pages/([\w/-]+)\.md')  # as the repository has it
_TEXT_CELL = re.compile(r'<div class="[^"]*jp-RenderedMarkdown.*?</div>', re.DOTALL)
_FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$]+)\$", re.DOTALL)
# Links come first, so that an image within one stays as it is.
_IMAGE = re.compile(r'<a\b.*?</a>|<img\b[^>]*?\bsrc="([^"]+)"[^>]*>', re.DOTALL)
_DATA = re.compile(r'src="data:image/png;base64,[^"]*"')
_CELL = re.compile(r"<td\b.*?</td>", re.DOTALL)
# Of tables; tags and code stay as they are.
_NUMBER = re.compile(r"<code>.*?</code>|<[^>]*>|([\d.)]+e-\d+|\d+ \d{3})\b")
_OBJECT = re.compile(r"^::: manifold_jax\.([\w.]+)$", re.MULTILINE)


def on_config(config: Any) -> Any:
    config.markdown_extensions.append(Formulas())
    return config


@event_priority(100)  # before the plugin that makes pages of notebooks
def on_files(files: Files, config: Any) -> Files:
    for name, (folder, patterns) in FOLDERS.items():
        for path in sorted(path for pattern in patterns for path in folder.glob(pattern)):
            uri = f"{name}/{path.relative_to(folder).as_posix()}"
            files.append(File(uri, str(folder.parent), config.site_dir, config.use_directory_urls))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        pictures = _pictures(path)
        named = {f"{path.stem}-{number}": picture for number, picture in enumerate(pictures)}
        named |= {path.stem: pictures[-1]} if pictures else {}  # for other pages
        for name, picture in named.items():
            files.append(File.generated(config, f"notebooks/{name}.png", content=picture))
    pages = {uri: path.read_text() for uri, path in PAGES.items()}
    pages |= _by_question(pages["benchmarks.md"])
    generated = [File.generated(config, uri, content="") for uri in pages]
    for file in generated:
        files.append(file)
    for file in generated:
        file.content_string = _linked(pages[file.src_uri], files)
    return files


def _pictures(notebook: Path) -> list[bytes]:
    cells = json.loads(notebook.read_text())["cells"]
    shown = [output.get("data", {}) for cell in cells for output in cell.get("outputs", ())]
    return [base64.b64decode("".join(data["image/png"])) for data in shown if "image/png" in data]


def _by_question(text: str) -> dict[str, str]:
    """Each section of the benchmarks but the last, the method, becomes a page of its own."""
    overview, *sections, method = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    pages = {}
    for section in sections:
        name = slugify(section.splitlines()[0], "-")
        pages[f"benchmarks-{name}.md"] = re.sub(r"^#(?=#)", "", section, flags=re.MULTILINE)
        overview = overview.replace(f"(#{name})", f"(benchmarks-{name}.md)")
    return pages | {"benchmarks.md": overview + method}


def _linked(text: str, files: Files) -> str:
    """Links to what is in the repository alone become text."""
    text = text.replace("](../docs/pages/", "](")
    is_here = lambda target: "://" in target or files.get_file_from_path(target) is not None
    return _LINK.sub(lambda m: m[0] if is_here(m[2]) else m[1], text)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Docstrings refer to `[Projected][]` or `[mj.Projected][]`: anchors with these names. Answers to
    questions are the first that the search finds."""
    if page.file.src_uri == "questions.md":
        page.meta["search"] = {"boost": 4}
    return _OBJECT.sub(_with_anchors, markdown)


def _with_anchors(match: re.Match[str]) -> str:
    name = match[1]
    # Within `mj.multibody` docstrings leave that out.
    anchors = (name, f"mj.{name}", *re.findall(r"^multibody\.(\w+)$", name))
    return "\n".join(f"[](){{#{anchor}}}" for anchor in anchors) + f"\n\n{match[0]}"


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Images become links to their files. Of notebooks: formulas and links as on other pages, and without
    the scripts that would load MathJax and Mermaid from elsewhere."""
    if page.file.src_uri.endswith(".ipynb"):
        html = re.sub(r"<script\b.*?</script>", "", html, flags=re.DOTALL)
        html = _PAGE.sub(r'href="../\1.html', html)
        html = html.replace(
            'class="anchor-link"', 'class="headerlink"'
        )  # which the search leaves out
        html = _TEXT_CELL.sub(lambda text: _FORMULA.sub(_formula, text[0]), html)
        number = itertools.count()
        name = Path(page.file.src_uri).stem
        html = _DATA.sub(lambda _: f'src="{name}-{next(number)}.png"', html)
    html = _CELL.sub(lambda cell: _NUMBER.sub(_in_one_line, cell[0]), html)
    return _IMAGE.sub(_enlargeable, html)


def _in_one_line(match: re.Match[str]) -> str:
    return f'<span class="number">{match[1]}</span>' if match[1] else match[0]


def _enlargeable(match: re.Match[str]) -> str:
    image, source = match[0], match[1]
    return f'<a class="image-link" href="{source}">{image}</a>' if source else image


def _formula(match: re.Match[str]) -> str:
    display, inline = match.groups()
    source = unescape(display or inline).replace("\n", " ")
    return convert(source, display="block" if display else "inline")


class Formulas(Extension):
    """`$...$`, and `$$...$$` as a paragraph, as MathML, which browsers draw by themselves."""

    def extendMarkdown(self, md: Markdown) -> None:
        inline = r"(?<![\\$\w])\$([^$\s][^$]*?)\$(?![\d$])"
        md.inlinePatterns.register(_Inline(inline, md), "formula", 185)
        md.parser.blockprocessors.register(_Display(md.parser), "formula", 76)


class _Inline(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:  # pyright: ignore
        html = convert(m[1].replace("\n", " "))
        return self.md.htmlStash.store(html), m.start(0), m.end(0)


class _Display(BlockProcessor):
    _whole = re.compile(r"\s*\$\$(.*)\$\$([.,;]?)\s*", re.DOTALL)

    def test(self, parent: Element, block: str) -> bool:
        return self._whole.fullmatch(block) is not None

    def run(self, parent: Element, blocks: list[str]) -> None:
        match = self._whole.fullmatch(blocks.pop(0))
        assert match is not None
        html = convert(match[1].replace("\n", " ") + match[2], display="block")
        SubElement(parent, "p").text = self.parser.md.htmlStash.store(html)
