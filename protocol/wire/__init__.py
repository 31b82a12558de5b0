"""Messages as MessagePack bytes: keys, programs of calls, replies, maps and records.

::

    request  [version, epoch, sequence, program]      program: the bytes of [shape, numbers]
    reply    [version, shape, numbers, error, compute_time]     error: nil or a map
             and [number, first] behind that, if the model has given warnings

    shape    the bytes of [call, call, ...] or [result, result, ...] with their numbers left out
    numbers  all those numbers, float64, little-endian, in order
    call     ["set_inputs", rows, columns]            numbers: rows x columns
             ["do_step", no_set_state_prior]          numbers: communication point, step size
             [verb, field, field, ...]                all others, no numbers left out
    result   [rows, columns] for outputs              numbers: rows x columns
             status for a step                        numbers: time
             [n, other, other, ...] for recorded      numbers: n of floating-point types
             what it is, for all others               a description is a map by field name

From one double step to the next only the numbers change, so a shape is parsed and checked once and
then looked up: the hot path is one copy of a block of numbers.

A single verb travels as a map of the call's fields, and its answer as a map with ``result``, so
that any Zenoh client with a MessagePack library can drive a slave by hand (``docs/protocol.md``).

Lengths and depths are limited before anything is built, no type is chosen by the sender, and
every value is checked against the type that the call declares: what comes out of this package is
well-formed or a `MalformedMessageError`.
"""
