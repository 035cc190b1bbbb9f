"""Assigns poses to the pictures of a video.

Metadata in or with a picture's own packet (SEI, djmd) belongs to that packet and follows it through the decoder
(`telemetry.videos.extraction`), so that B-frames and threads cannot mix it up. Metadata with its own times (KLV,
subtitles) is interpolated at the picture's time. The sources are merged field by field, the one with a position first.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from telemetry.formats.log.mavlink_poses import fixed_camera
from telemetry.formats.video import srt
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline
from telemetry.samples.wild_fixes import sound_positions
from telemetry.videos.video_file import VideoScan, square_size

_SUBTITLE_EXCESS_S: Final = 3.0  # subtitles that end later than their video by more than this are of another length
_HELD_AT_ENDS_S: Final = 1.0  # metadata counts this long before its first and after its last value


@dataclass(frozen=True, slots=True)
class PicturePose:
    """The merged sample of a picture and the sources of its parts."""

    sample: Sample
    origin: str


class VideoClock:
    """UTC of video times, from pairs of both; beyond its ends it continues at rate one."""

    def __init__(self, pairs: Iterable[tuple[float, float]]) -> None:
        table = np.array(list(pairs), dtype=np.float64).reshape(-1, 2)
        self._video, self._utc = table[np.argsort(table[:, 0], kind="stable")].T

    def __len__(self) -> int:
        return len(self._video)

    def at(self, video_s: Array) -> Array:
        """UTC epoch seconds, NaN where the time is NaN or nothing is known."""
        if len(self) == 0:
            return np.full(video_s.shape, np.nan)
        inside = np.clip(video_s, self._video[0], self._video[-1])
        return np.asarray(np.interp(inside, self._video, self._utc) + (video_s - inside))

    @property
    def rate(self) -> float:
        """Seconds of UTC per second of video; NaN if too few times are known."""
        if len(self) < 5 or self._video[-1] - self._video[0] < 0.2:
            return float("nan")
        return float(np.polyfit(self._video - self._video[0], self._utc - self._utc[0], 1)[0])


class Poses:
    """The pose of each picture of a video.

    Attributes:
        findings: irregularities in the video's metadata.
    """

    def __init__(self, found: VideoScan, subtitles: srt.Subtitles | None = None) -> None:
        self._scan = found
        self._interval = 1.0 / found.rate if found.rate else 1.0 / 30.0
        self.findings: list[Finding] = []
        self._djmd = self._sound("djmd", sorted(found.djmd_samples, key=lambda row: row[0]))
        self._djmd_times = np.array([row[0] for row in self._djmd])
        # Whole seconds: the largest difference belongs to a time at which the second had just begun.
        self._djmd_clock = max((s.time_s - t for t, s in self._djmd if s.time_s is not None), default=None)
        rated = (i * self._interval if found.rate else float("nan") for i in range(len(found.pictures)))
        known = [note.video_s for note in found.pictures]
        self._times = np.array([other if t is None else t for t, other in zip(known, rated)], dtype=np.float64)
        self._trust_sei_times = True
        self._interpolated: list[tuple[str, list[Sample]]] = []
        self._sei = self._sei_samples()
        # A file beside the video counts before its own track, unless it is of some other kind.
        cues = subtitles or found.cues
        if found.cues.has_positions and not cues.has_positions:
            cues = found.cues
        self._add("KLV", self._klv_rows())
        self._add("GPMF", [(t, s) for t, s in found.gpmf_samples if s.has_position])
        rows = [(c.start_s, c.sample) for c in cues.cues if c.sample is not None and c.sample.has_position]
        self._add("SRT", rows, cues.joints_s)
        self._note_file()
        self._note(cues)

    def of(self, index: int) -> PicturePose | None:
        """Pose of the picture of a packet (its index in `VideoScan.pictures`); None if unknown."""
        note, t = self._scan.pictures[index], self._times[index]
        parts: list[tuple[Sample, str]] = []
        own = self._sei[index]
        if own is not None:
            if own.time_s is not None and not self._trust_sei_times:
                own = replace(own, time_s=None)
            parts.append((own, " + ".join(note.decoders)))
        with_packet = self._own_djmd(t)
        if with_packet is not None:
            if self._djmd_clock is not None and t == t:
                with_packet = replace(with_packet, time_s=float(t) + self._djmd_clock)
            parts.append((with_packet, "djmd"))
        for name, samples in self._interpolated:
            if samples[index].has_position or samples[index].yaw_deg is not None:
                parts.append((samples[index], name))
        if self._scan.created_s is not None and t == t:
            parts.append((Sample(time_s=self._scan.created_s + float(t)), ""))
        if not parts:
            return None
        # Samples with a position come first; a time stamp alone has the better time.
        parts.sort(key=lambda part: not part[0].has_position)
        merged = parts[0][0]
        if own is not None and own.time_s is not None:
            merged = replace(merged, time_s=own.time_s)
        for sample, _ in parts[1:]:
            merged = merged.merge(sample)
        return PicturePose(merged, " + ".join(name for _, name in parts if name))

    @property
    def has_positions(self) -> bool:
        """Whether any source of this video has positions."""
        return any(sample.has_position for sample in self._all_samples())

    @property
    def has_angles(self) -> bool:
        """Whether any source of this video has a camera's yaw."""
        return any(sample.yaw_deg is not None for sample in self._all_samples())

    def _all_samples(self) -> Iterator[Sample]:
        for _, samples in self._interpolated:
            yield from samples
        yield from (sample for sample in self._sei if sample is not None)
        yield from (sample for _, sample in self._djmd)

    def add_track(self, name: str, timeline: Timeline, offset_s: float, *, has_gimbal: bool) -> int:
        """Add a vehicle's log as the last source; returns the number of pictures it gives a pose.

        Args:
            name: origin of its fields. timeline: the vehicle's poses over UTC. offset_s: video time minus UTC.
            has_gimbal: False if the camera is assumed fixed under the airframe.
        """
        samples = timeline.at_all(self._times - offset_s)
        if not has_gimbal:
            samples = [fixed_camera(sample) for sample in samples]
        for sample in samples:
            if sample.time_s != sample.time_s:
                sample.time_s = None
        self._interpolated.append((name, samples))
        return sum(sample.has_position for sample in samples)

    @property
    def clock_s(self) -> float | None:
        """UTC of video time zero by the metadata, in which a zone may be missing; None if it has no times."""
        poses = ((t, self.of(i)) for i, t in enumerate(self._times.tolist()) if t == t)
        starts = [p.sample.time_s - t for t, p in poses if p is not None and p.sample.time_s is not None]
        return float(np.median(starts)) if starts else None

    def track(self) -> tuple[Array, Array]:
        """Video times (N,) and positions (N, 2), latitude and longitude in degrees, of pictures that have one."""
        rows = [
            (t, pose.sample.lat_deg, pose.sample.lon_deg)
            for i, t in enumerate(self._times.tolist())
            if t == t and (pose := self.of(i)) is not None and pose.sample.has_position
        ]
        table = np.array(rows, dtype=np.float64).reshape(-1, 3)
        return table[:, 0], table[:, 1:]

    def _own_djmd(self, t: float) -> Sample | None:
        """The djmd message with the picture's own time."""
        if not self._djmd or t != t:
            return None
        i = int(np.argmin(np.abs(self._djmd_times - t)))
        return self._djmd[i][1] if abs(self._djmd_times[i] - t) < 0.51 * self._interval else None

    def _add(self, name: str, rows: list[tuple[float, Sample]], joints_s: Sequence[float] = ()) -> None:
        """Interpolate a source with times of its own at all pictures, but not from one recording to the next.

        Args:
            rows: video times and samples.
            joints_s: video times at which the source's next recording begins, besides the file's own.
        """
        if not rows:
            return
        joints = np.array(sorted({*self._scan.joints_s, *joints_s}))
        part_of_row = np.searchsorted(joints, [t for t, _ in rows], side="right")
        part_of_picture = np.searchsorted(joints, self._times, side="right")
        samples = [Sample() for _ in range(len(self._times))]
        for part in np.unique(part_of_row).tolist():
            own = self._sound(name, [rows[i] for i in np.flatnonzero(part_of_row == part).tolist()])
            index = np.flatnonzero(part_of_picture == part)
            for i, sample in zip(index.tolist(), _interpolated(own, self._times[index]), strict=True):
                samples[i] = sample
        self._interpolated.append((name, samples))

    def _sei_samples(self) -> list[Sample | None]:
        """The pose in each picture's own packet."""
        samples = [None if note.sample is None else self._turned(note.sample) for note in self._scan.pictures]
        part = np.searchsorted(np.array(self._scan.joints_s), self._times, side="right")
        for k in np.unique(part).tolist():
            index = [i for i in np.flatnonzero(part == k).tolist() if samples[i] is not None]
            rows = self._sound("SEI", [(float(self._times[i]), sample) for i in index if (sample := samples[i])])
            for i, (_, sample) in zip(index, rows, strict=True):
                samples[i] = sample
        return samples

    def _sound(self, name: str, rows: list[tuple[float, Sample]]) -> list[tuple[float, Sample]]:
        """Samples of one recording over video time, without positions that cannot be flown."""
        samples, wild = sound_positions(
            [s for _, s in rows], [t if t == t else s.time_s for t, s in rows], f"{self._scan.path.name} ({name})"
        )
        self.findings += wild
        return [(t, sample) for (t, _), sample in zip(rows, samples, strict=True)]

    def _turned(self, sample: Sample) -> Sample:
        """A pose from the stream of pictures itself, which describes them as coded, for the pictures as shown."""
        found = self._scan
        return found.turn.sample(sample, *square_size(found.width, found.height, found.aspect))

    def _klv_rows(self) -> list[tuple[float, Sample]]:
        """KLV poses with video times: their own, else from UTC and the SEI times, else from their place in the file."""
        rows = [
            (t, after, self._turned(p.sample))
            for t, after, p in self._scan.klv_packets
            if p.sample is not None and p.sample.has_position
        ]
        if not rows:
            return []
        own = ((n.video_s, n.sample.time_s) for n in self._scan.pictures if n.sample is not None)
        sei_clock = VideoClock((t, utc_s) for t, utc_s in own if t is not None and utc_s is not None)
        dated = ((t, s.time_s) for t, _, s in rows if t is not None and s.time_s is not None)
        self._compare_clocks(sei_clock, VideoClock(dated))
        if all(t is not None for t, _, _ in rows):
            return [(t, s) for t, _, s in rows if t is not None]
        utc = np.array([s.time_s if s.time_s is not None else np.nan for _, _, s in rows])
        known = ~np.isnan(self._times)
        if len(sei_clock) > 1 and known.any():
            # The pictures' own UTC, in order, inverted: from UTC to video time.
            moments = np.sort(self._times[known])
            at = sei_clock.at(moments)
            if np.mean((utc >= at[0] - 1.0) & (utc <= at[-1] + 1.0)) > 0.5 and np.all(np.diff(at) > 0):
                inside = np.clip(utc, at[0], at[-1])
                times = np.interp(inside, at, moments) + (utc - inside)
                return [(float(t), s) for t, (_, _, s) in zip(times, rows, strict=True) if t == t]
        last = len(self._times) - 1
        return [(float(self._times[min(after, last)]), s) for _, after, s in rows if last >= 0]

    def _compare_clocks(self, sei_clock: VideoClock, klv_clock: VideoClock) -> None:
        """Report SEI time stamps that contradict the KLV's; ignore them if their rate is wrong."""
        name = self._scan.path.name
        ratio = sei_clock.rate / klv_clock.rate if klv_clock.rate > 0 else float("nan")
        if ratio == ratio and not 0.8 < ratio < 1.25:
            self._trust_sei_times = False
            text = f"the SEI time stamps of {name} run {ratio:.3g} times as fast as its KLV times; they are not used"
            self.findings.append(Finding("sei-clock", text))
        elif len(sei_clock) and len(klv_clock):
            known = self._times[~np.isnan(self._times)]
            offset = float(np.median(sei_clock.at(known) - klv_clock.at(known)))
            if abs(offset) > 0.5:
                text = (
                    f"the SEI times of {name} are {offset:+.1f} s off its KLV times; poses are bound by the "
                    "transport's time stamps"
                )
                self.findings.append(Finding("clock-offset", text))

    def _note_file(self) -> None:
        """Report what of the file is read otherwise than it looks."""
        found, name = self._scan, self._scan.path.name
        if found.joints_s:
            text = (
                f"the clock of {name} starts again {plural(len(found.joints_s), 'time')} (recordings joined, or "
                "an encoder restarted); its parts are read one after the other"
            )
            self.findings.append(Finding("times-restart", text, note=True))
        size = square_size(found.width, found.height, found.aspect)
        if size != (found.width, found.height):
            text = (
                f"the pixels of {name} are not square ({found.aspect:.3f} as wide as high); its pictures are "
                f"stretched from {found.width}x{found.height} to {size[0]}x{size[1]}"
            )
            self.findings.append(Finding("pixels-not-square", text, note=True))
        if not (found.has_times or any(n.sample is not None and n.sample.has_position for n in found.pictures)):
            text = (
                f"{name} is a raw stream that states no frame rate, so that no SRT and no log can be matched with its "
                f"pictures; put it into an MP4 with its rate (ffmpeg -framerate 30 -i {name} -c copy "
                f"{found.path.stem}.mp4)"
            )
            self.findings.append(Finding("rate-unknown", text))
        if not found.turn.is_none:
            turned = f"turned by {found.turn.clockwise_deg} degrees clockwise" if found.turn.clockwise_deg else ""
            mirrored = "mirrored" if found.turn.is_mirrored else ""
            text = (
                f"the pictures of {name} are {' and '.join(filter(None, (mirrored, turned)))}, as the file tells "
                "players to show them"
            )
            self.findings.append(Finding("pictures-turned", text, note=True))
        if found.others:
            others = ", ".join(f"{columns}x{rows}" for columns, rows in found.others)
            text = (
                f"{name} holds {1 + len(found.others)} videos; the one with most pixels ({found.width}x{found.height}) "
                f"is mapped, {others} not: save them as files of their own to map them"
            )
            self.findings.append(Finding("video-streams", text))

    def _note(self, cues: srt.Subtitles) -> None:
        name = self._scan.path.name
        sizes: dict[str, list[int]] = {}
        for uuid, size in self._scan.unknown_sei:
            sizes.setdefault(uuid, []).append(size)
        for uuid, found in sizes.items():
            count = sum(self._scan.unknown_sei[uuid, size] for size in found)
            span = f"{min(found)}" if len(found) == 1 else f"{min(found)} to {max(found)}"
            text = (
                f"{plural(count, 'SEI message')} of {name} with UUID {uuid} and {span} bytes are not known; if they "
                "hold poses, describe their layout with --sei-layout"
            )
            self.findings.append(Finding("sei-unknown", text, note=True))
        errors = Counter(packet.error for _, _, packet in self._scan.klv_packets if packet.error)
        for reason, count in errors.items():
            self.findings.append(Finding("klv-damaged", f"{plural(count, 'KLV packet')} of {name} refused: {reason}"))
        if any(packet.kind == "EG 0104" for _, _, packet in self._scan.klv_packets):
            text = f"the KLV of {name} is EG 0104, an older set than ST 0601"
            self.findings.append(Finding("klv-eg0104", text, note=True))
        self.findings += [
            Finding(code, text, note=code == "srt-tuple-order") for code, text in cues.notes.items() if cues.cues
        ]
        ends = self._times[~np.isnan(self._times)]
        last_s = max((cue.end_s for cue in cues.cues if cue.sample is not None), default=0.0)
        if len(ends) and last_s > ends.max() + _SUBTITLE_EXCESS_S and cues.has_positions:
            text = (
                f"the subtitles of {name} last {last_s:.0f} s, its pictures {ends.max() + self._interval:.0f} s: if "
                "the video was cut or sped up, its pictures lie elsewhere; give the video as the camera wrote it, or "
                "cut the subtitles like it"
            )
            self.findings.append(Finding("srt-length", text))


def _interpolated(rows: list[tuple[float, Sample]], times: Array) -> list[Sample]:
    """Samples with video times at other video times; their UTC goes on beyond them.

    They are extended at their ends by one usual interval (at most a second), as pictures lie between samples.
    """
    utc = VideoClock((t, s.time_s) for t, s in rows if s.time_s is not None).at(times)
    known = [replace(s, time_s=t) for t, s in sorted(rows, key=lambda row: row[0])]
    moments = np.array([t for t, _ in rows], dtype=np.float64)
    usual = float(np.median(np.diff(np.sort(moments)))) if len(rows) > 1 else _HELD_AT_ENDS_S
    usual = min(max(usual, 1e-3), _HELD_AT_ENDS_S)
    before = replace(known[0], time_s=float(moments.min()) - usual)
    after = replace(known[-1], time_s=float(moments.max()) + usual)
    samples = Timeline([before, *known, after], max_gap_s=max(2.0, 4.0 * usual)).at_all(times)
    for sample, moment in zip(samples, utc.tolist(), strict=True):
        sample.time_s = moment if moment == moment else None
    return samples
