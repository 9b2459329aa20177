"""The generator of the tasks: the committed output is current, and bad XML is refused."""

import inspect
import shutil
import sys
from pathlib import Path

import pytest

from casa_sara.private import parameters
from casa_sara.private.validation import Parameter

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import taskxml
import xml2task

SMALL = """<casaxml xmlns="http://casa.nrao.edu/schema/psetTypes.html">
<task type="function" name="small" category="imaging">
  <shortdescription>Do little</shortdescription>
  <description>Does little.</description>
  <input>
    <param type="any" name="vis" mustexist="true" required="true">
      <shortdescription>Input</shortdescription>
      <description>The input.</description>
      <type>path</type><type>pathVec</type>
      <value type="path"/>
    </param>
    <param type="string" name="mode">
      <shortdescription>Mode</shortdescription>
      <description>The mode.</description>
      <value>soft</value>
      <allowed kind="enum"><value>soft</value><value>hard</value></allowed>
    </param>
    <param type="double" name="softness" subparam="true">
      <shortdescription>Softness</shortdescription>
      <description>
        How soft.
          Very.
      </description>
      <value>0.5</value>
      <allowed kind="range"><value range="min">0</value><value range="max">1</value></allowed>
    </param>
    <param type="int" name="steps">
      <shortdescription>Steps</shortdescription>
      <description>How many.</description>
      <value>3</value>
    </param>
    <param type="stringVec" name="names" subparam="true">
      <shortdescription>Names</shortdescription>
      <description>Their names.</description>
      <value><value>a</value></value>
    </param>
    <constraints>
      <when param="mode">
        <equals type="string" value="soft"><default param="softness"><value>0.5</value></default></equals>
      </when>
      <when param="steps">
        <notequals type="int" value="0"><default param="names"><value><value>a</value></value></default></notequals>
      </when>
    </constraints>
  </input>
  <returns>dict</returns>
  <example>
    Do it:

    small(vis='x.ms', mode='hard')

    In the shell:

    inp small
    vis = 'x.ms'
    go
  </example>
</task>
</casaxml>
"""

# What is replaced in SMALL, by what, and what the error says.
MISTAKES = {
    "unknown element": ("<returns>", "<author>me</author><returns>", "unknown element <author>"),
    "unknown element in a parameter": ("<value>3</value>", "<value>3</value><any/>", "unknown element <any>"),
    "unknown attribute": ('name="steps"', 'name="steps" visible="no"', "unknown attribute visible"),
    "flag that is not true": ('required="true"', 'required="false"', "unknown attribute required='false'"),
    "unknown namespace": ("psetTypes.html", "other.html", "should be <casaxml>"),
    "text between elements": ("<value>3</value>", "<value>3</value> three", "text in <param>"),
    "not XML": ("</casaxml>", "", "small.xml: no element found"),
    "another name than the file": ('name="small"', 'name="large"', "the name of the file"),
    "no short description": ("<shortdescription>Steps</shortdescription>", "", "0 elements <shortdescription>"),
    "long short description": ("Do little", "Do\nlittle", "should be one line"),
    "empty description": ("<description>How many.</description>", "<description/>", "should have text"),
    "backslash": ("How many.", "How \\many.", "without"),
    "keyword as name": ('name="steps"', 'name="lambda"', "not a name"),
    "duplicate name": ('name="steps"', 'name="mode"', "param mode: is there twice"),
    "unknown type": ('type="int" name="steps"', 'type="integer" name="steps"', "unknown type 'integer'"),
    "any of one type": ("<type>path</type><type>pathVec</type>", "<type>path</type>", "two or more <type>"),
    "types without any": ("<value>3</value>", "<type>int</type><type>double</type><value>3</value>", "two or more"),
    "missing default": ("<value>3</value>", "", "0 elements <value>"),
    "empty default": ("<value>3</value>", "<value/>", "'' is not of type int"),
    "default of another type": ("<value>3</value>", "<value>3.5</value>", "'3.5' is not of type int"),
    "default of an unlisted type": ('<value type="path"/>', '<value type="int"/>', "should be one of path"),
    "default without type": ('<value type="path"/>', "<value/>", "needs the attribute type"),
    "default not allowed": ("<value>soft</value>\n", "<value>softer</value>\n", "'softer' is not among the allowed"),
    "default out of range": ("<value>0.5</value>\n", "<value>1.5</value>\n", "1.5 is not among the allowed"),
    "allowed twice": ("<value>hard</value>", "<value>soft</value>", "an allowed value is there twice"),
    "range of strings": ('kind="enum"', 'kind="range"', "a range, of numbers"),
    "two minima": ('range="max"', 'range="min"', "one min, one max"),
    "sub-parameter that nothing opens": (
        '<when param="mode">\n        <equals type="string" value="soft"><default param="softness"><value>0.5</value>'
        "</default></equals>\n      </when>", "", "softness: is a sub-parameter that nothing opens"),
    "opened parameter that is no sub-parameter": (
        'name="softness" subparam="true"', 'name="softness"', "should name a sub-parameter"),
    "opened by two": ('param="names"', 'param="softness"', "softness: is opened twice"),
    "opened by equals and notequals": (
        "</equals>", '</equals><notequals type="string" value="hard"><default param="softness"><value>0.5</value>'
        "</default></notequals>", "by both equals and notequals"),
    "opened twice in one branch": (
        "</equals>", '<default param="softness"><value>0.5</value></default></equals>', "softness: is opened twice"),
    "same branch twice": (
        "</equals>", '</equals><equals type="string" value="soft"><default param="softness"><value>0.5</value>'
        "</default></equals>", "equals 'soft' is there twice"),
    "opener of several types": ('<when param="steps">', '<when param="vis">', "should name a parameter of one type"),
    "opener that is a sub-parameter": (
        '<when param="steps">\n        <notequals type="int"',
        '<when param="softness">\n        <notequals type="double"',
        "names: should stand right behind softness"),
    "when of an unknown parameter": ('when param="mode"', 'when param="mood"', "when mood: should name a parameter"),
    "when of the same parameter twice": ('when param="steps"', 'when param="mode"', "when mode: should name"),
    "when-value not allowed": ('value="soft"', 'value="softly"', "'softly' is not a value of mode"),
    "when-value of another type": ('<notequals type="int"', '<notequals type="bool"', "0 is not a value of steps"),
    "constraint on an unknown parameter": ('default param="names"', 'default param="name"', "default name: should"),
    "constraint with another default": (
        '"softness"><value>0.5</value>', '"softness"><value>0.6</value>', "differs from the parameter's own default"),
    "example without caption": ("Do it:\n", "Do it.\n", "example: should begin with a caption"),
    "example that is no code": ("small(vis='x.ms', ", "small vis='x.ms', ", "is not Python"),
    "example without the task": ("small(vis=", "tiny(vis=", "should call small, by keywords only"),
    "example with an unknown parameter": ("mode='hard')", "mood='hard')", "small has no parameter mood"),
    "example with a value not allowed": ("mode='hard')", "mode='harder')", "'harder' is not a value of mode"),
    "example of the shell without end": ("    go\n", "", "should end with go"),
    "example of the shell with an unknown parameter": ("vis = 'x.ms'", "ms = 'x.ms'", "small has no parameter ms"),
    "empty constraints": ('<when param="steps">', '<when param="steps"/><when param="steps">', "open something"),
}


def write(folder: Path, text: str, name: str = "small") -> Path:
    (folder / "xml").mkdir(exist_ok=True)
    path = folder / "xml" / f"{name}.xml"
    path.write_text(text)
    return path


def test_committed_tasks_are_what_the_xml_says(capsys):
    assert xml2task.main(["--check"]) == 0, capsys.readouterr().err


def test_small_task_is_read_as_written(tmp_path):
    task = taskxml.read_task(write(tmp_path, SMALL))
    params = {param.name: param for param in task.params}
    assert list(params) == ["vis", "mode", "softness", "steps", "names"]
    assert [param.default for param in task.params] == ["", "soft", 0.5, 3, ["a"]]
    assert params["vis"].types == ("path", "pathVec") and params["vis"].mustexist and params["vis"].required
    assert params["mode"].allowed == ("soft", "hard")
    assert (params["softness"].minimum, params["softness"].maximum) == (0, 1)
    assert params["softness"].description == "How soft.\n  Very."
    assert (params["softness"].opener, params["softness"].opening, params["softness"].values) == (
        "mode", "equals", ("soft",))
    assert (params["names"].opener, params["names"].opening, params["names"].values) == ("steps", "notequals", (0,))


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_refused(tmp_path, mistake):
    old, new, message = MISTAKES[mistake]
    assert old in SMALL
    with pytest.raises(taskxml.TaskError, match=message.replace("(", r"\(")):
        taskxml.read_task(write(tmp_path, SMALL.replace(old, new, 1)))


def test_examples_are_read_as_written(tmp_path):
    assert taskxml.read_task(write(tmp_path, SMALL)).examples == (
        ("Do it:", "small(vis='x.ms', mode='hard')"), ("In the shell:", "inp small\nvis = 'x.ms'\ngo"))


def test_sub_parameter_must_stand_behind_its_opener(tmp_path):
    start, end = SMALL.index('    <param type="int" name="steps">'), SMALL.index('    <param type="stringVec"')
    moved = SMALL[:start] + SMALL[end:].replace("    <constraints>", SMALL[start:end] + "    <constraints>")
    with pytest.raises(taskxml.TaskError, match="names: should stand right behind steps"):
        taskxml.read_task(write(tmp_path, moved))


def test_error_names_the_file_and_fails_the_command(tmp_path, capsys):
    write(tmp_path, SMALL.replace('name="steps"', 'name="mode"'))
    assert xml2task.main(["--root", str(tmp_path)]) == 1
    assert "small.xml: param mode: is there twice" in capsys.readouterr().err
    assert not (tmp_path / "casa_sara").exists()


def test_check_names_every_stale_file_and_writes_nothing(tmp_path, capsys):
    command = ["--root", str(tmp_path)]
    write(tmp_path, SMALL)
    tiny = SMALL.replace('name="small"', 'name="tiny"').replace("small(", "tiny(").replace("inp small", "inp tiny")
    write(tmp_path, tiny, "tiny")
    assert xml2task.main([*command, "--check"]) == 1
    assert not (tmp_path / "casa_sara").exists()
    assert xml2task.main(command) == 0 and xml2task.main([*command, "--check"]) == 0

    folder = tmp_path / "casa_sara"
    (folder / "tasks" / "small.py").write_text("# edited\n")
    (folder / "gotasks" / "tiny.py").unlink()
    (folder / "private" / "parameters.py").unlink()
    (folder / "gotasks" / "old.py").write_text("# of a task that is no more\n")
    capsys.readouterr()
    assert xml2task.main([*command, "--check"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == [
        "casa_sara/gotasks/old.py", "casa_sara/gotasks/tiny.py", "casa_sara/private/parameters.py",
        "casa_sara/tasks/small.py"]
    assert (folder / "tasks" / "small.py").read_text() == "# edited\n"
    assert xml2task.main(command) == 0 and xml2task.main([*command, "--check"]) == 0
    assert not (folder / "gotasks" / "old.py").exists()


def test_generated_task_has_what_the_xml_has(tmp_path, monkeypatch):
    xml = write(tmp_path, SMALL)
    task = taskxml.read_task(xml)
    tables, module = {}, {}
    exec(compile(xml2task.parameter_tables([task]), str(xml), "exec"), tables)
    monkeypatch.setattr(parameters, "SMALL", tables["SMALL"], raising=False)
    exec(compile(xml2task.plain_task(task), str(xml), "exec"), module)
    defaults = {name: p.default for name, p in inspect.signature(module["small"]).parameters.items()}
    assert defaults == {"vis": "", "mode": "soft", "softness": 0.5, "steps": 3, "names": ["a"]}
    assert tables["SMALL"] == module["SMALL"] == (
        Parameter("vis", ("path", "pathVec"), "", "Input", mustexist=True, required=True),
        Parameter("mode", ("string",), "soft", "Mode", allowed=("soft", "hard")),
        Parameter("softness", ("double",), 0.5, "Softness", minimum=0, maximum=1, opener="mode", open_on=("soft",)),
        Parameter("steps", ("int",), 3, "Steps"),
        Parameter("names", ("stringVec",), ["a"], "Names", opener="steps", open_unless=(0,)),
    )
    softness = "softness : float, default 0.5\n    Opened by mode = 'soft'.\n    How soft.\n      Very.\n"
    assert softness in inspect.getdoc(module["small"])


def test_second_task_joins_the_packages(tmp_path):
    write(tmp_path, SMALL)
    shutil.copy(ROOT / "xml" / "tsara.xml", tmp_path / "xml")
    files = xml2task.generate(tmp_path / "xml")
    for name, text in files.items():
        compile(text, name, "exec")
    for folder in ("tasks", "gotasks"):
        assert '__all__ = ["small", "tsara"]' in files[f"{folder}/__init__.py"]
