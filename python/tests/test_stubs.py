"""The stub has the names of the module, and the other way round."""

import ast
import inspect

from conftest import ROOT

import vidar


def names_of(nodes):
    """Public names that statements of a stub define."""
    found = set()
    for node in nodes:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, ast.AnnAssign):
            found.add(node.target.id)
    return {name for name in found if not name.startswith("_")}


def test_the_stub_has_the_names_of_the_module():
    stub = ast.parse((ROOT / "python/vidar.pyi").read_text()).body
    classes = {node.name: node for node in stub if isinstance(node, ast.ClassDef)}
    of_module = {name for name in dir(vidar) if not name.startswith("_")} - {"vidar"}
    assert names_of(stub) == of_module
    for name, node in classes.items():
        if name == "VidarError":
            continue
        members = {m for m in vars(getattr(vidar, name)) if not m.startswith("_")}
        assert names_of(node.body) == members, name


def test_everything_has_a_docstring():
    for name in dir(vidar):
        thing = getattr(vidar, name)
        if name.startswith("_") or inspect.ismodule(thing):
            continue
        assert thing.__doc__, name
        if inspect.isclass(thing) and thing is not vidar.VidarError:
            undocumented = [m for m, v in vars(thing).items() if not m.startswith("_") and not v.__doc__]
            assert not undocumented, (name, undocumented)
