"""Drive the slave `wheel` by hand, with zenoh and msgpack alone: see docs/protocol.md."""

import struct
import sys

import msgpack
import zenoh

config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{sys.argv[1]}"]}}}}')
with zenoh.open(config) as session:
    alive = next(iter(session.liveliness().get("doublestep/slaves/wheel/*/alive", timeout=5.0)))
    slave = str(alive.ok.key_expr).removesuffix("/alive")

    def call(verb, **fields):
        """Send one verb to the slave and give its result."""
        query = session.get(f"{slave}/{verb}", payload=msgpack.packb(fields), timeout=10.0)
        answer = msgpack.unpackb(next(iter(query)).ok.payload.to_bytes())
        return sys.exit(str(answer["error"])) if "error" in answer else answer["result"]

    call("reset")
    call("initialize", inputs=["x_c", "v_c"], outputs=["x", "v"])
    call("exit_initialization_mode")
    for time in (0.0, 0.01, 0.02):
        call("set_inputs", derivatives=[1, struct.pack("<2d", 0.0, 0.0)])
        status, end = call("do_step", communication_point=time, step_size=0.01)
        print(end, status, *struct.unpack("<2d", call("get_outputs")[1]))
