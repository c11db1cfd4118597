"""Pictures of a video topic of a bag: decoded from the key frame before the one asked for, or on from the one before."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_index import MAX_KEPT
from calib_ros.errors import BadInputError
from calib_ros.messages.video import Packet, VideoDecoder, packet_of, picture_of, pyav

KEY_FRAMES = "let the encoder make one each second (`gop_size`), and record again"
Name = tuple[int, int]  # of a message: time of recording, stamp of the header, ns
MAX_DELAY = 16  # pictures that a codec may hold back to put them in order
FIRST_LOOK = 8  # messages read at first to find a key frame; then twice as many each time
KEPT = 8  # of the newest pictures, for those that ask for neighbours, and for codecs that put pictures in order


class BagVideo:
    """Raises MissingDependencyError without PyAV."""

    def __init__(self, bag: BagFile, topic: str) -> None:
        pyav()
        self._bag, self._topic = bag, topic
        self._decoder: VideoDecoder | None = None
        self._waiting: list[Name] = []  # packets that the decoder has had, and has given no picture for
        self._newest: list[Name] = []  # packets that it has had last, all recorded at the same time
        self._pictures: dict[Name, Any] = {}  # the newest that came out
        self.decoded = 0  # packets in all

    def picture(self, recorded: int, header: int) -> NDArray[np.uint8]:
        """(H, W) grey or (H, W, 3) BGR of the message recorded and stamped then. Raises BadInputError without a key frame before
        it, or for a packet since then that is damaged or of another codec."""
        name = (recorded, header)
        if name not in self._pictures:
            try:
                self._decode(name)
            except BaseException:
                self._decoder = None
                raise
        return picture_of(self._pictures[name])

    def _decode(self, wanted: Name) -> None:
        decoder = self._decoder
        if decoder is None or wanted not in self._waiting:
            packets = self._since_key(wanted[0])
            if decoder is None or packets[0][1].is_key:
                decoder = self._decoder = VideoDecoder(packets[0][1].codec)
                self._waiting, self._newest = [], []
            self._feed(decoder, packets)
        if wanted not in self._pictures:  # the codec puts pictures in order
            at = self._newest[0][0]
            for one in self._packets(at, at + 2 * MAX_DELAY * self._bag.period(self._topic), self._newest)[:MAX_DELAY]:
                self._feed(decoder, [one])
                if wanted in self._pictures:
                    return
            self._keep(decoder.decode(None))
            self._decoder = None
        if wanted not in self._pictures:
            raise BadInputError("the video packet gives no picture; choose other frames")

    def _feed(self, decoder: VideoDecoder, packets: list[tuple[Name, Packet]]) -> None:
        for name, packet in packets:
            self._newest = [*(other for other in self._newest if other[0] == name[0]), name]
            self._waiting.append(name)
            self.decoded += 1
            self._keep(decoder.decode(packet.data, name))

    def _keep(self, pictures: list[tuple[Name, Any]]) -> None:
        for name, picture in pictures:
            self._waiting.remove(name)
            self._pictures[name] = picture
        while len(self._pictures) > KEPT:
            del self._pictures[next(iter(self._pictures))]

    def _packets(self, start: int, stop: int, but: list[Name]) -> list[tuple[Name, Packet]]:
        """The packets recorded in [start, stop)."""
        found = [((time, peek_header(data)[0]), data) for _, time, data in self._bag.raw([self._topic], start, stop)]
        return [(name, packet_of(self._bag.decode(self._topic, data))) for name, data in found if name not in but]

    def _since_key(self, recorded: int) -> list[tuple[Name, Packet]]:
        """The packets up to the message recorded then, from the last key frame on, or from where the decoder stands."""
        goes_on = self._decoder is not None and self._newest[0][0] < recorded
        first, had = (self._newest[0][0], self._newest) if goes_on else (self._bag.start, [])
        found: list[tuple[Name, Packet]] = []
        start, look, size = recorded + 1, FIRST_LOOK * self._bag.period(self._topic), 0
        while start > first and size <= MAX_KEPT:
            start, stop = max(start - look, first), start
            more = self._packets(start, stop, had)
            found, look = more + found, 2 * look
            size += sum(len(packet.data) for _, packet in more)
            keys = [k for k, (_, packet) in enumerate(found) if packet.is_key]
            if keys:
                return found[keys[-1] :]
        if not goes_on or start > first or not found:
            raise BadInputError(f"no key frame is near before this picture of the video; {KEY_FRAMES}")
        return found
