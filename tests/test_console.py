import argparse
import subprocess
import sys
from pathlib import Path

import pytest

from mambaloc.console import OptionParser, exit_on_input_error, thread_count, whole_number
from mambaloc.errors import InputError


@exit_on_input_error
def tool(error):
    raise error


def test_input_error_is_one_line_and_exit_code_2(capsys):
    with pytest.raises(SystemExit) as exit_:
        tool(InputError("a.txt: is empty; fill it"))
    assert exit_.value.code == 2
    assert capsys.readouterr().err == "error: a.txt: is empty; fill it\n"


def test_input_error_inside_a_librarys_error_is_found(capsys):
    wrapper = ValueError("does not validate")
    wrapper.__cause__ = InputError("a.txt: is empty; fill it")
    with pytest.raises(SystemExit):
        tool(wrapper)
    assert capsys.readouterr().err == "error: a.txt: is empty; fill it\n"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--port", "x"], "--port: x: give a whole number of at least 1; --help lists the options"),
        (["--port"], "--port: expected one argument; --help lists the options"),
        (["--prot=1"], "unrecognized arguments: --prot=1; --help lists the options"),
        (["part", "--size", "2.5"], "--size: 2.5: give a whole number of at least 1; --help lists the options"),
    ],
)
def test_a_wrong_option_is_one_line_without_the_usage(argv, message):
    parser = OptionParser()
    parser.add_argument("--port", type=whole_number(1))
    parser.add_subparsers().add_parser("part").add_argument("--size", type=whole_number(1))
    with pytest.raises(InputError) as error:
        parser.parse_args(argv)
    assert str(error.value) == message


def test_every_tool_answers_a_wrong_option_in_a_line():
    tools = Path(__file__).parents[1] / "tools"
    parsers = [path for path in tools.rglob("*.py") if "ArgumentParser(" in path.read_text()]
    assert parsers == []


def test_a_bug_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        tool(ZeroDivisionError())


def test_package_alone_imports_without_torch():
    code = "import sys, mambaloc; assert mambaloc.__version__; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("text", ["0", "-1", "257", "2.5", "two", "", "²"])
def test_a_number_of_threads_is_whole_and_within_bounds(text):
    with pytest.raises(argparse.ArgumentTypeError, match="give a whole number from 1 to 256"):
        thread_count(text)
    assert thread_count("256") == 256


def test_a_whole_number_may_have_no_upper_bound():
    assert whole_number(32)("100000") == 100_000
    with pytest.raises(argparse.ArgumentTypeError, match="31: give a whole number of at least 32"):
        whole_number(32)("31")
