"""Connection to a serial device: opens the port, reads its description, sends commands."""

import time
from typing import Final

from compute.errors import InvalidParameter
from hardware.errors import DeviceNotConnected
from hardware.serial.codec import encode
from hardware.serial.decoder import Decoder
from hardware.serial.frame_builder import ExposureAssembler
from hardware.serial.messages import (
    NO_MARKER,
    Ability,
    Answer,
    Describe,
    Description,
    Exposure,
    FromHost,
    Message,
    MessageType,
    Result,
    Start,
    Stop,
    Strobe,
)
from hardware.serial.port import CloseSignal, PortDisconnected, open_port
from hardware.serial.settings import SerialSettings

DESCRIBE_S: Final = 2.5
"""Time limit for the description; boards that reset when their port is opened take 2 s."""
ANSWER_S: Final = 1.0
_ASK_AGAIN_S: Final = 0.25

_COMMANDS: Final = {int(kind): kind.name.lower() for kind in MessageType}
_REFUSED: Final[dict[int, str]] = {
    Result.UNKNOWN: "it does not know the command",
    Result.OUT_OF_RANGE: "it cannot do that",
}


class Connection:
    """An open port whose device has sent its description.

    Args:
        settings: its port, and settings sent to it.
        decoder: decodes what comes; its counters go on from connection to connection.
        closing: ends all waiting.

    Raises:
        DeviceNotConnected: the port cannot be opened, or no description comes.
    """

    def __init__(self, settings: SerialSettings, decoder: Decoder, closing: CloseSignal) -> None:
        self._settings = settings
        self._decoder = decoder
        self._closing = closing
        self._number = 0
        self._busy = BusyRetry()
        decoder.reset()
        self._port = open_port(settings.url, settings.baudrate, closing)
        try:
            self.description = self._describe()
        except PortDisconnected as error:
            self.close()
            raise DeviceNotConnected(f"{settings.url}: {error}", url=settings.url) from error
        except BaseException:
            self.close()
            raise
        self.assembler = ExposureAssembler(len(self.description.sensors), self.description.pixels)

    def read(self, timeout_s: float) -> tuple[list[Message], int, bool]:
        """Read messages, waiting for the first at most ``timeout_s``.

        Returns:
            The messages, when their last byte came on the monotonic clock [ns], and whether any
            byte came.

        Raises:
            PortDisconnected: the connection is lost.
        """
        retry_ns = self._busy.retry_ns
        if retry_ns is not None:
            remaining_s = (retry_ns - time.monotonic_ns()) * 1e-9
            if remaining_s <= 0.0:
                self.send_settings()
            else:
                timeout_s = min(timeout_s, remaining_s)
        data = self._port.read(timeout_s)
        arrival_ns = time.monotonic_ns()
        return self._decoder.feed(data), arrival_ns, bool(data)

    def start(self) -> None:
        """Send rate, exposure and strobe schedule, and start the exposures.

        Raises:
            InvalidParameter: it does not support a setting, or refuses it.
            PortDisconnected: the connection is lost, or the device is busy for too long.
        """
        busy_until_ns = time.monotonic_ns() + BUSY_LIMIT_NS
        for command in self.commands():
            self._acknowledged(command, busy_until_ns)

    def request_description(self) -> None:
        """Request the description without waiting for it; raises PortDisconnected."""
        self._port.write(encode(Describe(self._next())))

    def send_settings(self) -> None:
        """Send all settings and the start, without waiting for the answers.

        Raises:
            InvalidParameter: it does not support a setting.
            PortDisconnected: the connection is lost.
        """
        commands = self.commands()
        for command in commands:
            self._port.write(encode(command))
        self._busy.sent(commands)

    def stop(self) -> None:
        """Stop the exposures, where the device can and the port is still open."""
        if self.description.abilities & Ability.START_STOP:
            try:
                self._port.write(encode(Stop(self._next())))
            except PortDisconnected:
                return

    def close(self) -> None:
        """Close the port; call from the reading thread, or when there is none."""
        self._port.close()

    def commands(self) -> list[FromHost]:
        """Return the commands that configure and start the device.

        Raises:
            InvalidParameter: it does not support a setting.
        """
        settings, commands = self._settings, list[FromHost]()
        if settings.frame_rate_hz is not None or settings.exposure_us is not None:
            self._check_ability(Ability.EXPOSURE, "frame_rate_hz and exposure_us")
            rate, exposure = settings.frame_rate_hz or 0.0, settings.exposure_us or 0.0
            commands.append(Exposure(self._next(), rate, exposure))
        if settings.strobe is not None:
            self._check_ability(Ability.STROBE, "strobe")
            if settings.strobe.markers > self.description.markers:
                raise InvalidParameter(
                    f"the strobe schedule lights {settings.strobe.markers} markers; "
                    f"{self.description.name} has {self.description.markers}",
                    markers=settings.strobe.markers,
                )
            slots = tuple(NO_MARKER if s is None else s for s in settings.strobe.slots)
            commands.append(Strobe(self._next(), slots))
        if self.description.abilities & Ability.START_STOP:
            commands.append(Start(self._next()))
        return commands

    def _check_ability(self, needed: Ability, what: str) -> None:
        if not self.description.abilities & needed:
            raise InvalidParameter(
                f"{self.description.name} does not support the setting of {what}; leave it out"
            )

    def _describe(self) -> Description:
        end = time.monotonic() + DESCRIBE_S
        came = False
        while time.monotonic() < end and not self._closing.is_set():
            self.request_description()
            again = min(end, time.monotonic() + _ASK_AGAIN_S)
            while (remaining_s := again - time.monotonic()) > 0.0 and not self._closing.is_set():
                messages, _, some = self.read(remaining_s)
                came = came or some
                for message in messages:
                    if isinstance(message, Description):
                        return message
        url = self._settings.url
        what = self._decoder.complaint
        if what is None:
            what = "what comes is not the line-scan protocol" if came else "nothing comes"
        raise DeviceNotConnected(
            f"{url} is open, but no device said what it is in {DESCRIBE_S:g} s: {what}", url=url
        )

    def _acknowledged(self, command: FromHost, busy_until_ns: int) -> None:
        """Send a command until it is done: twice, and repeatedly while the device is busy."""
        unanswered = 0
        while not self._closing.is_set():
            self._port.write(encode(command))
            answer = self._await(command.number, ANSWER_S)
            if answer is None:
                unanswered += 1
                if unanswered == 2 and not self._closing.is_set():
                    name = type(command).__name__.lower()
                    raise PortDisconnected(f"it did not answer the command {name}")
            elif answer.result != Result.BUSY:
                self._check_answer(answer)
                return
            elif time.monotonic_ns() > busy_until_ns:
                raise PortDisconnected(f"the device is busy for {BUSY_LIMIT_NS * 1e-9:g} s")
            else:
                self._await(None, RETRY_INTERVAL_NS * 1e-9)

    def _await(self, number: int | None, seconds: float) -> Answer | None:
        """Read for a time, or until the answer with this number arrives."""
        end = time.monotonic() + seconds
        while (remaining_s := end - time.monotonic()) > 0.0 and not self._closing.is_set():
            for message in self.read(remaining_s)[0]:
                if isinstance(message, Answer) and message.number == number:
                    return message
        return None

    def handle_answer(self, answer: Answer, now_ns: int) -> None:
        """Handle an answer to ``send_settings``; ``read`` repeats them to a busy device.

        Raises:
            InvalidParameter: the command was refused.
            PortDisconnected: the device is busy for too long.
        """
        self._busy.answered(answer, now_ns)
        if answer.result != Result.BUSY:
            self._check_answer(answer)

    def _check_answer(self, answer: Answer) -> None:
        """Raise InvalidParameter when a command was refused."""
        if answer.result == Result.DONE:
            return
        command = _COMMANDS.get(answer.command, f"{answer.command:#x}")
        settings = self._settings
        slots = settings.strobe.slots if settings.strobe else None
        raise InvalidParameter(
            f"{self.description.name} refused the command {command} (frame_rate_hz "
            f"{settings.frame_rate_hz}, exposure_us {settings.exposure_us}, strobe {slots}): "
            f"{_REFUSED.get(answer.result, f'result {answer.result}')}",
            command=command,
            result=answer.result,
        )

    def _next(self) -> int:
        self._number = (self._number + 1) % 2**16
        return self._number


BUSY_LIMIT_NS: Final = 3_000_000_000
"""Time for which a device may be busy before its connection counts as lost."""
RETRY_INTERVAL_NS: Final = 250_000_000


class BusyRetry:
    """Tracks unacknowledged commands and schedules their repetition to a busy device.

    Attributes:
        retry_ns: when the commands are to be sent again; None: they are not.
    """

    def __init__(self) -> None:
        self.retry_ns: int | None = None
        self._since_ns: int | None = None
        self._open: set[int] = set()

    def sent(self, commands: list[FromHost]) -> None:
        """Register the commands just sent, in place of all earlier ones."""
        if self.retry_ns is None:  # for another reason than that it was busy
            self._since_ns = None
        self._open = {command.number for command in commands}
        self.retry_ns = None

    def answered(self, answer: Answer, now_ns: int) -> None:
        """Register an answer.

        Raises:
            PortDisconnected: the device is busy for too long.
        """
        if answer.number not in self._open:
            return
        if answer.result != Result.BUSY:
            self._open.discard(answer.number)
            if not self._open:
                self._since_ns = None
            return
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns > BUSY_LIMIT_NS:
            raise PortDisconnected(f"the device is busy for {BUSY_LIMIT_NS * 1e-9:g} s")
        if self.retry_ns is None:
            self.retry_ns = now_ns + RETRY_INTERVAL_NS
