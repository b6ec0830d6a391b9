"""The parts of a Markdown document that can be run: fenced blocks of ``console`` and of ``python``."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<body>.*?)^(?P=indent)```\s*$", re.MULTILINE | re.DOTALL)
_NOT_RUN = re.compile(r"<!-- not run: (?P<reason>[^>]+) -->\s*\Z")
_NEEDS_DATA = re.compile(r"<!-- needs CLIPMAP_TEST_DATA -->\s*\Z")


@dataclass(frozen=True)
class Step:
    """A command and the output shown below it, or a piece of Python; ``line`` is where it stands in the document."""

    language: Literal["console", "python"]
    line: int
    text: str
    expected: str = ""
    not_run: str | None = None
    needs_data: bool = False

    @property
    def in_background(self) -> bool:
        """Whether the command ends in ``&``."""
        return self.language == "console" and self.text.rstrip().endswith("&")


def parse_steps(document: str) -> list[Step]:
    """Return the steps of ``document`` in order.

    In a ``console`` block a line that begins with ``$ `` is a command, a trailing backslash continues it on the next line,
    and other lines are its output, in which ``...`` stands for anything. A block right below the comment
    ``<!-- not run: REASON -->`` is not for this test to run. A block that names CLIPMAP_TEST_DATA anywhere, or stands right below
    the comment ``<!-- needs CLIPMAP_TEST_DATA -->``, needs the real inputs as a whole.
    """
    steps: list[Step] = []
    for fence in _FENCE.finditer(document):
        language, first_line = fence["language"], document.count("\n", 0, fence.start("body")) + 1
        marker = _NOT_RUN.search(document[: fence.start()])
        reason = marker["reason"] if marker else None
        needs_data = "CLIPMAP_TEST_DATA" in fence["body"] or _NEEDS_DATA.search(document[: fence.start()]) is not None
        if language == "python":
            steps.append(Step("python", first_line, fence["body"], "", reason, needs_data))
        elif language == "console":
            steps += [
                Step("console", line, command, output, reason, needs_data) for line, command, output in _commands(fence["body"], first_line)
            ]
    return steps


def _commands(body: str, first_line: int) -> Iterator[tuple[int, str, str]]:
    lines = list(enumerate(body.splitlines(), first_line))
    while lines:
        number, line = lines.pop(0)
        if not line.lstrip().startswith("$ "):
            raise ValueError(f"line {number}: a console block must begin with a command, '$ ...', not with {line!r}")
        command = line.lstrip()[2:]
        while command.endswith("\\") and lines:
            command = command[:-1] + lines.pop(0)[1].strip().removeprefix("> ")
        output = []
        while lines and not lines[0][1].lstrip().startswith("$ "):
            output.append(lines.pop(0)[1])
        yield number, command, "\n".join(output).strip()
