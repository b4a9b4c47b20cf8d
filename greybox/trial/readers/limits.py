"""What reading one log may cost: one object of bounds, and the threats that it answers."""

from __future__ import annotations

from dataclasses import dataclass

GIB = 2**30


@dataclass(frozen=True)
class Limits:
    """Bounds of memory, time and nesting while one log is read.

    A log is a stranger's file: damaged on its way, cut by a recorder that was killed, or
    written to do harm. It may cost the user a refusal in one sentence, never the machine
    or the session. The threats, and what stands against each:

    - *A few bytes unpack to many* (zip bombs, run lengths, sparse matrices): what compressed
      data state is checked before they are unpacked, and counted while they are.
    - *Sizes are stated that the file does not hold*: nothing is allocated for a stated size;
      it is compared with the bytes that are there.
    - *Many small things* (cells, fields, topics, columns, messages, notes), each dearer in
      memory than in the file: they are counted.
    - *Nesting and self-reference*: depth is counted, so that no recursion runs away.
    - *Endless lines and texts*: files are read in blocks, texts are cut.
    - *Libraries that crash or never return on damaged data* (SciPy on MATLAB files): they run
      in a process of their own, with a bound of memory and time.
    - *Content that runs as code* (pickles, SQL views, message definitions, YAML tags, links
      to other files): never executed or followed; no number bounds that.

    Honest logs lie far inside: a day of 100 channels at 10 Hz is 0.7 GB of numbers, and
    tables of any length are read in blocks.

    Parameters
    ----------
    held_bytes : int
        Held in memory as a whole: the variables of a MATLAB file, a chunk or record of a
        bag, a row group of Parquet.
    held_ratio : int
        A row group may be this many times as large as its file, where that is more.
    unpacked_bytes, unpacked_ratio : int
        All that the compressed parts of a bag hold together: this much, or so many times
        the size of the file where that is more.
    process_bytes, process_seconds : int
        Address space and time of a reader in a process of its own. Three copies of
        `held_bytes` must fit beside the libraries.
    window_bytes : int
        Look-back that zstd may ask for; what its own tool accepts unasked.
    block_bytes, block_rows : int
        Read at a time from files that are not held as a whole; no line of a table is longer.
    values : int
        Numbers kept of a bag or a MATLAB file: 1 GiB of them.
    items : int
        Variables, fields and cells of a MATLAB file.
    messages, topics, topic_fields : int
        Of a bag; fields of one topic.
    columns : int
        Of a text table.
    matrix_columns : int
        Columns of one matrix, cells and structs of one array that become signals.
    elements : int
        Longer arrays inside messages are covariances, ranges or pictures: noted, not signals.
    dense_elements : int
        A sparse matrix is made dense up to this many.
    depth : int
        Structs in structs, messages in messages.
    text : int
        Characters kept of a word: the mode of a controller or a date is shorter.
    line_bytes : int
        Of an NMEA 0183 sentence: the standard allows 82, receivers and tag blocks take more.
    head_bytes : int
        Searched for the header of a text table.
    definition_bytes : int
        Text that defines the messages of a topic.
    sidecar_bytes : int
        Metadata of a bag, record beside a log.
    notes : int
        Remarks on one MATLAB file.
    row_bytes : int
        Of a row in a large row group with texts: a thousand columns take eight thousand.
    rows_per_byte, sure_rows : int
        Rows that Parquet may state for each byte of the file, and in any case: times are
        never repeated, even delta coding needs a bit or two for each.
    """

    held_bytes: int = GIB // 2
    held_ratio: int = 4
    unpacked_bytes: int = 2 * GIB
    unpacked_ratio: int = 16
    process_bytes: int = 2 * GIB
    process_seconds: int = 60
    window_bytes: int = 2**27
    block_bytes: int = 2**23
    block_rows: int = 2**17
    values: int = 2**27
    items: int = 500_000
    messages: int = 20_000_000
    topics: int = 2000
    topic_fields: int = 200
    columns: int = 4096
    matrix_columns: int = 64
    elements: int = 16
    dense_elements: int = 1_000_000
    depth: int = 16
    text: int = 256
    line_bytes: int = 1024
    head_bytes: int = 2**22
    definition_bytes: int = 2**18
    sidecar_bytes: int = 2**22
    notes: int = 60
    row_bytes: int = 2**16
    rows_per_byte: int = 8
    sure_rows: int = 1_000_000


_LIMITS = Limits()


def limits() -> Limits:
    """Return the bounds that hold for every reader."""
    return _LIMITS
