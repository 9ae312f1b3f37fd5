"""A program with MAVSDK's parameter plugin as anybody would write it; prints one line of JSON with what it saw.

Argument: UDP port of the vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys

import mavsdk as native
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.param import ParamAsync, ParamError, ProtocolVersion

PATIENCE_S = 20.0


async def outcome(request) -> str:
    """How a request ends."""
    try:
        await request
    except ParamError as error:
        return str(error).split(";")[0].split(":")[0]
    return "SUCCESS"


async def session(param: ParamAsync) -> dict:
    everything = await param.get_all_params()
    seen = {"ints": len(everything.int_params), "floats": len(everything.float_params)}
    seen["differ"] = [x.name for x in everything.float_params if await param.get_param_float(x.name) != x.value]
    seen["set"] = await outcome(param.set_param_float("OC_K1", 2.2))
    seen["heading"] = await outcome(param.set_param_int("OC_HDG_KIND", 2))
    seen["refused"] = await outcome(param.set_param_float("OC_GAMMA", 500.0))
    seen["type"] = await outcome(param.set_param_int("OC_K1", 3))
    seen["unknown"] = await outcome(param.get_param_float("OC_NONE"))
    seen["values"] = [
        round(await param.get_param_float("OC_K1"), 6),
        await param.get_param_int("OC_HDG_KIND"),
        await param.get_param_float("OC_GAMMA"),
    ]
    seen["reset"] = await outcome(param.set_param_int("OC_RESET", 1))
    seen["after"] = [await param.get_param_float("OC_K1"), await param.get_param_int("OC_HDG_KIND")]
    return seen


async def main(port: int) -> None:
    native.log_subscribe(lambda *_: True)
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as sdk:
        await sdk.add_any_connection(f"udpout://127.0.0.1:{port}")
        for _ in range(100):
            systems = await sdk.get_systems()
            if systems:
                break
            await asyncio.sleep(0.1)
        else:
            raise SystemExit("no vehicle")
        param = ParamAsync(systems[0])
        with contextlib.suppress(ParamError):  # it selects the component and then says that the result is unknown
            param._plugin.select_component(191, ProtocolVersion.V1)
        print(json.dumps(await asyncio.wait_for(session(param), PATIENCE_S)), flush=True)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1])))
