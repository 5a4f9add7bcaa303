"""Names of tables that can be called for the tables."""

from __future__ import annotations

import pyarrow as pa

from cluster_est.results.table_names import TableNames


def test_it_is_its_names_and_called_it_makes_their_tables():
    made = []

    def make(name):
        made.append(name)
        return pa.table({name: [1]})

    names = TableNames(("errors", "effects"), make)
    assert names == ("errors", "effects")
    assert repr(names) == "('errors', 'effects')"
    assert made == []
    tables = names()
    assert list(tables) == ["errors", "effects"]
    assert tables["effects"].column_names == ["effects"]
