"""docs/law.md names functions, configuration keys and figures: all of them must exist and be right."""

import ast
import re
from pathlib import Path

import pytest
from law_cases import PAPER_GAINS
from pydantic import BaseModel

from companion.config import Controller, Flight, FlightLimits, Vehicle
from companion.control import law
from companion.control.certificate import certify

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "law.md").read_text(encoding="utf-8")
CODE_SPANS = re.findall(r"(?<!`)`([^`\n]+)`(?!`)", TEXT)
BLOCKS = re.findall(r"^```\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
REFERENCE = re.compile(r"\b((?:[a-z_]+/)*[a-z_]+\.py): (\w+(?:\.\w+)?)")
REFERENCES = sorted(set(REFERENCE.findall(TEXT)))
SECTIONS = {
    **{name: field.annotation for name, field in Vehicle.model_fields.items()},
    **{name: field.annotation for name, field in Flight.model_fields.items()},
}
KEYS = sorted({span for span in CODE_SPANS if re.fullmatch(r"[a-z]+\.[a-z0-9_]+", span) and not span.endswith(".py")})


def names_of(module):
    """Top-level functions, classes and constants of a module, and Class.method or Class.property of its classes."""
    names = set()
    for node in module.body:
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.ClassDef):
            names.add(node.name)
            names |= {f"{node.name}.{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)}
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
    return names


def is_key(dotted):
    section, key = dotted.split(".")
    model = SECTIONS.get(section)
    return isinstance(model, type) and issubclass(model, BaseModel) and key in model.model_fields


@pytest.mark.parametrize(("path", "name"), REFERENCES)
def test_every_function_that_is_named_exists(path, name):
    file = ROOT / "companion" / path
    assert file.is_file(), f"docs/law.md names {path}, which does not exist"
    assert name in names_of(ast.parse(file.read_text(encoding="utf-8"))), f"{path} has no {name}"


def test_a_python_file_is_only_named_with_what_it_holds_or_by_its_path():
    for span in CODE_SPANS:
        if ".py" in span:
            assert REFERENCE.fullmatch(span) or (ROOT / span).is_file(), span


@pytest.mark.parametrize("key", KEYS)
def test_every_configuration_key_that_is_named_exists(key):
    assert is_key(key), f"docs/law.md names {key}, which companion/config.py does not have"


def test_every_gain_and_limit_is_in_the_table():
    wanted = {f"controller.{key}" for key in Controller.model_fields}
    wanted |= {f"limits.{key}" for key in FlightLimits.model_fields}
    assert wanted <= set(KEYS), f"missing in docs/law.md: {sorted(wanted - set(KEYS))}"


def test_the_law_is_covered_by_references():
    """Each public function of the law, its heading, certificate and margins is named, so none can be added unseen."""
    named = set(REFERENCES)
    for path in ("control/law.py", "control/certificate.py", "control/heading.py", "control/sampled.py"):
        module = ast.parse((ROOT / "companion" / path).read_text(encoding="utf-8"))
        functions = {node.name for node in module.body if isinstance(node, ast.FunctionDef)}
        public = {name for name in functions if not name.startswith("_")}
        assert public <= {name for file, name in named if file == path}, path


def test_every_limit_flag_is_explained():
    flags = {name for name in vars(law) if name.startswith("LIMIT_")}
    assert flags == {span for span in CODE_SPANS if span.startswith("LIMIT_")}


def test_links_within_the_page_lead_somewhere():
    headings = {
        re.sub(r"[^a-z0-9 -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in TEXT.splitlines()
        if line.startswith("#")
    }
    targets = re.findall(r"\]\(#([^)]+)\)", TEXT)
    assert targets and set(targets) <= headings


def numbers(cell):
    return [float(x) for x in cell.split(",")]


ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")] for line in TEXT.split("| Gamma | D |")[1].splitlines()[2:6]
]


@pytest.mark.parametrize("row", ROWS)
def test_the_eigenvalues_and_poles_of_the_table_are_those_of_the_code(row):
    gamma, drag, inside, outside, poles = row
    found = certify(PAPER_GAINS._replace(gamma=float(gamma)), float(drag))
    assert numbers(inside) == pytest.approx(found.inside, abs=5.1e-5)
    assert numbers(outside) == pytest.approx(found.outside, abs=5.1e-5)
    stated = []
    for pole in poles.split(", "):
        real, _, imaginary = pole.partition(" ± ")
        size = float(imaginary.rstrip("i") or 0.0)
        stated += [complex(float(real), -size), complex(float(real), size)] if size else [complex(float(real), 0.0)]
    order = [(x.real, x.imag) for x in found.poles]
    assert [(x.real, x.imag) for x in stated] == [pytest.approx(x, abs=5.1e-4) for x in order]
