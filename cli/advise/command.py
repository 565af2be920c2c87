"""``locatk advise``: the four systems side by side for a task, before anything is bought."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import combine
from locatk.cli.price_options import price_options
from locatk.cli.settings_command import CONFIG_FILE, PRINT_CONFIG, SettingsCommand

QUESTIONS = (
    ("area.size_m", "Area in metres, as in 10x8"),
    ("area.height_m", "Height of the ceiling in metres"),
    ("area.ceiling", "May stations be mounted on ceiling or walls"),
    ("area.infrared", "Infrared light (none, windows, sun)"),
    ("area.iron", "Iron in the floor (none, reinforced, plates)"),
    ("area.floor", "What may be done to the floor (print, glue, mill, none)"),
    ("robots.count", "Number of robots"),
    ("robots.flying", "Do they fly"),
    ("robots.speed_mps", "Speed in m/s"),
    ("wanted.position_mm", "Position error that 95 % of the poses may have, in mm"),
    ("wanted.heading_deg", "Heading error that 95 % of the poses may have, in degrees"),
)
"""Key of a setting and the question for it, asked on a terminal if no task is given."""


@combine(
    click.command(
        "advise",
        cls=SettingsCommand,
        module="locatk.formats.advice.task_settings",
        short_help="Compare the four systems for a task before buying.",
    ),
    options.input_option(
        "--task",
        CONFIG_FILE,
        metavar="TOML",
        help="Task (task.toml); the options below override it.",
    ),
    click.option(
        "--print-task",
        PRINT_CONFIG,
        is_flag=True,
        is_eager=True,
        help="Print the task as a TOML file with comments, and do nothing else.",
    ),
    options.output_option(
        "--report", help="Page to write (.html), with maps and tables.", endings=(".html", ".htm")
    ),
    price_options,
    options.overwrite,
    options.as_json,
    options.verbosity,
)
def command(
    settings: Mapping[str, Any],
    input_files: list[Path],
    report: Path | None,
    prices: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare the four systems for a task: accuracy, cost, work and risks.

    Each system is designed for the task, and its accuracy is predicted, without hardware. The
    output lists what each system reaches, which requirements it does not meet and what would have
    to change, parts, working hours and power. Without a task, questions are asked on a terminal.

    The exit status is 3 if no system meets all requirements.

    \b
    Examples:
      locatk advise
      locatk advise --area 10x8 --robots 20 --accuracy 10
      locatk advise --area 4x4 --accuracy 1 --heading 1 --no-ceiling --floor print
      locatk advise --route aisle.csv --iron reinforced --report plan.html
      locatk advise --print-task > task.toml
      locatk advise --task task.toml --prices prices.toml --json
    """
    from locatk.cli.advise import text
    from locatk.core.advice.comparison import advise
    from locatk.formats.advice.entries import advice_entry
    from locatk.formats.advice.task_settings import CONFIG, task_of
    from locatk.formats.artifacts.prices import read_price_list

    if report is not None:
        inputs = [*input_files, *([prices] if prices else [])]
        options.guard_output(report, overwrite=overwrite, inputs=inputs)
    if not settings and not input_files:
        settings = _ask(CONFIG)
    task = task_of(settings)
    price_list = read_price_list(prices)
    with console.working("Designing") as show:
        advice = advise(task, price_list, lambda system: show(f"Designing {system}", 0, 0))
    console.result(text.text(task, advice))
    if report is not None:
        from locatk.formats.report.plan import write_plan

        write_plan(report, task, advice, CONFIG.dumps(settings), overwrite=overwrite)
        console.result(f"\nWrote {report}")
    if as_json:
        entry = {"version": 1, "settings": settings, **advice_entry(advice)}
        if report is not None:
            entry["report"] = report
        console.emit_json(entry)
    if advice.best is None:
        raise failures.Incomplete("no system meets all requirements")


def _ask(config: Any) -> dict[str, Any]:
    """Ask for the settings of a task on a terminal.

    Raises
    ------
    UsageError
        There is no terminal.
    """
    if not _has_terminal():
        raise click.UsageError(
            "No task: give --area, --accuracy and others, or --task. --print-task prints all "
            "settings."
        )
    console.say("Press Enter for the value in brackets.")
    answers: dict[str, Any] = {}
    for key, question in QUESTIONS:
        setting = config.setting(key)
        answers |= _answer(question, key, setting, config.default_text(setting))
    console.say("\nThe same again, and all other settings:\n  " + _command_line(config, answers))
    return answers


def _has_terminal() -> bool:
    return sys.stdin.isatty()


def _answer(question: str, key: str, setting: Any, default_text: str) -> dict[str, Any]:
    """Ask until the answer is valid; an empty answer leaves the default."""
    default = {"true": "yes", "false": "no"}.get(default_text, default_text)
    while True:
        text = click.prompt(question, default=default, err=True).strip()
        if text == default:
            return {}
        try:
            return {key: _parse(setting.kind, text)}
        except ValueError as error:
            console.message(f"{text!r}: {getattr(error, 'message', error)}.")


def _parse(kind: Any, text: str) -> Any:
    """Return the value of an answer.

    Raises
    ------
    ValueError
        It is not of this kind.
    """
    from locatk.formats.artifacts.kinds import Boolean, ListOf

    if isinstance(kind, Boolean):
        words = {"yes": True, "y": True, "true": True, "no": False, "n": False, "false": False}
        if text.lower() not in words:
            raise ValueError("expected yes or no")
        return words[text.lower()]
    if isinstance(kind, ListOf):
        return kind.parse([word for word in text.replace(",", " ").split() if word != "and"])
    return kind.parse_text(text) if hasattr(kind, "parse_text") else kind.parse(text)


def _command_line(config: Any, answers: Mapping[str, Any]) -> str:
    """Return the command with the options of the answers."""
    words = ["locatk advise"]
    for key, value in answers.items():
        flag = config.setting(key).flag
        if isinstance(value, bool):
            words.append(flag.split("/")[0 if value else 1])
        elif key == "area.size_m":
            words.append(f"{flag} {value[0]:g}x{value[1]:g}")
        elif isinstance(value, tuple):
            words += [f"{flag} {item}" for item in value]
        else:
            words.append(f"{flag} {value:g}" if isinstance(value, float) else f"{flag} {value}")
    return " ".join(words)
