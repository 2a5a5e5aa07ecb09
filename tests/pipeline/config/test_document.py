"""YAML from others: limits, duplicates and errors of one line."""

import pytest

from flexroad.pipeline.config.document import MAX_BYTES, MAX_DEPTH, MAX_VALUES, parse
from flexroad.pipeline.errors import ConfigError

LAUGHS = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10))
MERGED = "a0: &a0 {x: 1}\n" + "".join(
    f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}], y{n}: 1}}\n" for n in range(1, 10)
)
SECRET = "root:x9Kq"


def refusal(text: str | bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        parse(text if isinstance(text, bytes) else text.encode(), "x.yaml")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300
    return str(caught.value)


def test_parse_valid_file_returns_value_and_lines():
    value, lines = parse(
        b"\xef\xbb\xbf# caf\xc3\xa9\nfit: &f {degree: 3}\n\nvariants: {a: {fit: *f}, b: {fit: {<<: *f}}}\n",
        "x",
    )
    assert value == {
        "fit": {"degree": 3},
        "variants": {"a": {"fit": {"degree": 3}}, "b": {"fit": {"degree": 3}}},
    }
    assert lines == {"fit": 2, "variants": 4}
    assert parse(b"# nothing\n", "x")[0] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, f"more than {MAX_VALUES} values"),
        (MERGED, f"more than {MAX_VALUES} values"),
        ("[" + "1," * (MAX_VALUES + 1) + "]", f"more than {MAX_VALUES} values"),
        ("a: " + "[" * 100_000, f"line 1, column {MAX_DEPTH + 3}: nested more than {MAX_DEPTH} deep"),
        (
            "a0: &a0 [1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, 2000)),
            f"nested more than {MAX_DEPTH} deep",
        ),
        ("a: &a [*a]", "line 1, column 8: an alias of a value within this value"),
        ("a: &a {<<: *a}", "an alias of a value within this value"),
        ("a: " + "9" * 5000, "line 1, column 4: a number of more than 100 characters"),
        ("a: 0x" + "f" * 5000, "a number of more than 100 characters"),
        ("a: " + "1:" * 3000 + "1", "a number of more than 100 characters"),
        ("fit:\n  degree: 2\n  degree: 3\n", "line 3, column 3: the key 'degree' is also in line 2; remove"),
        ("{fit: 1, fit: 2}", "line 1, column 10: the key 'fit' is also in line 1"),
        ('{1: a, "1": b}', "the key '1' is also in line 1"),
        ("a: b\0c", "line 1: the character #x0000 is not allowed"),
        ("a: 1\nb: 2020-13-45", "line 2, column 4: the value is no timestamp; put a text in quotes"),
        ("a: !!int x", "the value is no int"),
        ("a: !!bool x", "the value is no bool"),
        ("a: !!timestamp x", "the value is no timestamp"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("a: 1\n--- \nb: 2", "but found another document"),
        (b"a: 1\nb: caf\xe9", "line 2 is not in UTF-8"),
        ("a: 1".encode("utf-16"), "line 1 is not in UTF-8"),
        (b"a" * (MAX_BYTES + 1), f"at most {MAX_BYTES}"),
    ],
)
def test_parse_hostile_or_wrong_file_gives_one_line(text, message):
    assert message in refusal(text)


@pytest.mark.parametrize(
    "text", ["{SECRET", "a: [SECRET\nb: 1", "a: 'SECRET", "SECRET\n\tx", "- SECRET\nb: 1"]
)
def test_parse_message_has_no_text_of_the_file(text):
    assert SECRET not in refusal(text.replace("SECRET", SECRET))
