"""Run in a process of its own: the package ndicapi, as software with an NDI driver uses it.

Prints one JSON object of what it was told. Its calls hold the interpreter, so that no server could
run beside it in one process.
"""

import json
import sys
from pathlib import Path

import ndicapy as ndi


def ask(device, command):
    """Return the reply; errors raise OSError.

    Binary replies are parsed, and then returned as text, which not all are in UTF-8.
    """
    try:
        return ndi.ndiCommand(device, command)
    except UnicodeDecodeError:
        return ""


def poses(device, command, transform_of, frame_of, status_of, handles):
    ask(device, command)
    return {
        handle: [
            transform_of(device, bytes([handle])),
            frame_of(device, bytes([handle])),
            status_of(device, bytes([handle])),
        ]
        for handle in handles
    }


def main(port: int, rom: str | None) -> None:
    device = ndi.ndiOpenNetwork("127.0.0.1", port)
    if not device:
        raise SystemExit("no connection")
    told = {"init": ask(device, "INIT:")}
    told["ver"] = ndi.ndiVER(device, 0)
    told["apirev"] = ask(device, "APIREV:")
    told["beep"] = ask(device, "BEEP:1")
    if rom is not None:
        ask(device, "PHRQ:*********1****")
        told["requested"] = ndi.ndiGetPHRQHandle(device)
        ndi.ndiPVWRFromFile(device, told["requested"], rom)
    ask(device, "PHSR:02")
    handles = [
        ndi.ndiGetPHSRHandle(device, number)
        for number in range(ndi.ndiGetPHSRNumberOfHandles(device))
    ]
    told["tools"] = {}
    for handle in handles:
        ask(device, f"PINIT:{handle:02X}")
        ask(device, f"PHINF:{handle:02X}0025")
        told["tools"][handle] = ndi.ndiCommand(device, f"PHINF:{handle:02X}0004").strip()
        ask(device, f"PENA:{handle:02X}D")
    ask(device, "TSTART:")
    told["tx"] = poses(
        device, "TX:0801", ndi.ndiGetTXTransform, ndi.ndiGetTXFrame, ndi.ndiGetTXPortStatus, handles
    )
    told["tx_system"] = ndi.ndiGetTXSystemStatus(device)
    told["bx"] = poses(
        device,
        "BX:0801",
        ndi.ndiGetBXTransform,
        ndi.ndiGetBXFrame,
        ndi.ndiGetBXPortStatus,
        handles,
    )
    told["bx_system"] = ndi.ndiGetBXSystemStatus(device)
    ask(device, "TX:180F")
    ask(device, "BX:180F")
    told["more"] = {
        handle: [
            ndi.ndiGetBXTransform(device, bytes([handle])),
            ndi.ndiGetBXFrame(device, bytes([handle])),
        ]
        for handle in handles
    }
    told["stop"] = ask(device, "TSTOP:")
    try:
        ndi.ndiCommand(device, "PENA:7FD")
    except OSError as error:
        told["error"] = str(error)
    ndi.ndiCloseNetwork(device)
    json.dump(told, sys.stdout)


main(int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 and Path(sys.argv[2]).exists() else None)
