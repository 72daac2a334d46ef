"""The list of mutations is true to the code; `python -m tests.mutations` runs them."""

import pytest

from tests.mutations import MUTATIONS, ROOT, is_there


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_what_a_mutation_replaces_is_still_there_and_its_tests_are_too(mutation):
    assert is_there(mutation), f"{mutation.old!r} is not once in {mutation.file}: mend the list"
    for test in mutation.tests:
        file, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}" in (ROOT / file).read_text(encoding="utf-8")
