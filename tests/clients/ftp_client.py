"""A program with MAVSDK's FTP plugin as anybody would write it; prints one line of JSON with what it saw.

Arguments: UDP port of the vehicle, folder with lap.csv and bad.csv.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import mavsdk as native
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.ftp import FtpAsync
from mavsdk.plugins.ftp import FtpError

PATIENCE_S = 20.0


async def outcome(transfer) -> str:
    """How a transfer, or a single request, ends."""
    try:
        if hasattr(transfer, "__aiter__"):
            async for _ in transfer:
                pass
        else:
            await transfer
    except FtpError as error:
        return str(error).split(";")[0].split(":")[0]
    return "SUCCESS"


async def session(ftp: FtpAsync, folder: Path) -> dict:
    seen = {}
    seen["upload"] = await outcome(ftp.upload(str(folder / "lap.csv"), "/"))
    seen["listed"] = [[e.name, e.size_bytes] for e in (await ftp.list_directory("/")).entries]
    seen["identical"] = await ftp.are_files_identical(str(folder / "lap.csv"), "/lap.csv")
    for use_burst in (False, True):
        there = folder / f"burst {use_burst}"
        there.mkdir()
        seen[f"download {use_burst}"] = await outcome(ftp.download("/lap.csv", str(there), use_burst))
    seen["refused"] = await outcome(ftp.upload(str(folder / "bad.csv"), "/"))
    seen["directory"] = await outcome(ftp.create_directory("/sub"))
    seen["rename"] = await outcome(ftp.rename("/lap.csv", "/new.csv"))
    seen["remove"] = await outcome(ftp.remove_file("/new.csv"))
    seen["remove none"] = await outcome(ftp.remove_file("/none.csv"))
    seen["outside"] = await outcome(ftp.remove_file("/../lap.csv"))
    return seen


async def main(port: int, folder: Path) -> None:
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
        ftp = FtpAsync(systems[0])
        ftp._plugin.set_target_compid(191)
        print(json.dumps(await asyncio.wait_for(session(ftp, folder), PATIENCE_S)), flush=True)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), Path(sys.argv[2])))
