"""A program with MAVSDK alone that commands `companion serve`; prints one line of JSON with what it saw.

Arguments: UDP port of the ground link.
"""

from __future__ import annotations

import asyncio
import json
import sys

import mavsdk as native
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.plugins.mavlink_direct import MavlinkMessage

PATIENCE_S = 40.0
IN_PROGRESS = 5
START, PAUSE_CONTINUE, STOP = 31010, 193, 31011


class Commander:
    """Gives commands to component 191 and waits for their end."""

    def __init__(self, direct: MavlinkDirectAsync) -> None:
        self._direct = direct
        self._acks: asyncio.Queue[dict] = asyncio.Queue()
        self._listener = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        async for message in self._direct.subscribe_message("COMMAND_ACK"):
            if message.component_id == 191:
                await self._acks.put(json.loads(message.fields_json))

    async def command(self, number: int, first: float) -> int:
        fields = {"command": number, "confirmation": 0, "target_system": 1, "target_component": 191}
        fields |= {f"param{i}": 0.0 for i in range(2, 8)} | {"param1": first}
        await self._direct.send_message(MavlinkMessage("COMMAND_LONG", 245, 190, 1, 191, json.dumps(fields)))
        while True:
            ack = await asyncio.wait_for(self._acks.get(), PATIENCE_S)
            if ack["command"] == number and ack["result"] != IN_PROGRESS:
                return int(ack["result"])

    async def phase(self, wanted: int) -> None:
        """Waits for a phase in the companion's heartbeat."""
        async for message in self._direct.subscribe_message("HEARTBEAT"):
            code = json.loads(message.fields_json)["custom_mode"]
            if message.component_id == 191 and code & 0xFF == wanted:
                return


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
        commander = Commander(MavlinkDirectAsync(systems[0]))
        await asyncio.sleep(0.2)
        seen = {"unknown": await commander.command(START, 99.0), "start": await commander.command(START, 1.0)}
        await asyncio.wait_for(commander.phase(5), PATIENCE_S)
        seen["pause"] = await commander.command(PAUSE_CONTINUE, 0.0)
        seen["resume"] = await commander.command(PAUSE_CONTINUE, 1.0)
        seen["stop"] = await commander.command(STOP, 0.0)
        print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1])))
