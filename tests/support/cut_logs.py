from pathlib import Path

import pyarrow as pa

from cluster_est.run_folder.log_segment import SegmentWriter, read_log


def write_log(folder: Path, table: pa.Table) -> None:
    """Put a log of one batch in the place of a folder's first segment."""
    with (folder / "00000.arrows").open("wb") as file:
        writer = SegmentWriter(file, table.schema)
        for batch in table.combine_chunks().to_batches():
            writer.write(batch)
        writer.close()


def cut(folder: Path, rows: int, torn: int = 0) -> None:
    """Leave the first rows of a log, then so many bytes of the batch that follows."""
    table = read_log(folder)
    for path in folder.glob("*.arrows"):
        path.unlink()
    path = folder / "00000.arrows"
    with path.open("wb") as file:
        writer = SegmentWriter(file, table.schema)
        for batch in table.slice(0, rows).to_batches(max_chunksize=17):
            writer.write(batch)
        file.flush()
        whole = file.tell()
        for batch in table.slice(rows).combine_chunks().to_batches():
            writer.write(batch)
        writer.close()
    with path.open("r+b") as file:
        file.truncate(whole + torn)
