"""Attitudes in the XMP of each manufacturer, converted to pitch -90 at nadir.

| properties | written by | pitch |
|---|---|---|
| `drone-dji:Gimbal*Degree`, `drone:Gimbal*Degree` | DJI; Autel since 2021 | -90 at nadir |
| `drone-skydio:CameraOrientationNED` with Yaw, Pitch, Roll | Skydio X2, X10 | -90 at nadir |
| `drone-yuneec:Gimbal*` | Yuneec | -90 at nadir |
| `drone-parrot:Camera*Degree` | Parrot | -90 at nadir |
| any other prefix with `Gimbal*Degree` | makers that follow DJI's names, such as Teal | -90 at nadir |
| `Camera:Yaw`, `Pitch`, `Roll` | Pix4D's name space: senseFly, MicaSense, Autel, Sequoia, this program | see below |
| `sensefly:Yaw`, `Pitch`, `Roll` | senseFly and AgEagle, older: the airframe's, camera fixed under it | 0 at nadir |

Sources: ExifTool's tag tables, published photos and packets of these makers.
"""

from typing import Final

from telemetry.formats.photo import xmp

Angles = tuple[float | None, float | None, float | None]  # yaw, pitch, roll in degrees

_DJI_NAMES = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
_FLIGHT_NAMES = ("FlightYawDegree", "FlightPitchDegree", "FlightRollDegree")
_ORIENTATION = "drone-skydio:CameraOrientationNED"
_CAMERA = (
    ("drone-dji", _DJI_NAMES),
    ("drone", _DJI_NAMES),
    ("drone-parrot", ("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree")),
    ("drone-yuneec", ("GimbalYaw", "GimbalPitch", "GimbalRoll")),
)
_FLIGHT = (
    ("drone-dji", _FLIGHT_NAMES),
    ("drone", _FLIGHT_NAMES),
    ("drone-parrot", ("DroneYawDegree", "DronePitchDegree", "DroneRollDegree")),
    ("drone-yuneec", ("DroneYaw", "DronePitch", "DroneRoll")),
)

_FROM_HORIZON_DEG: Final = -25.0  # pitches below this are counted from the horizon, not from nadir


def camera_angles(found: xmp.Properties, make: str) -> tuple[Angles, str] | None:
    """The camera's attitude and the prefix of its properties; None where there is none."""
    for prefix, names in _CAMERA:
        angles = _read(found, [f"{prefix}:{name}" for name in names])
        if angles is not None:
            return angles, prefix
    angles = _read(found, [f"{_ORIENTATION}/{name}" for name in ("Yaw", "Pitch", "Roll")])
    if angles is not None:
        return angles, "drone-skydio"
    angles = _read(found, ["Camera:Yaw", "Camera:Pitch", "Camera:Roll"])
    if angles is not None:
        return _from_pix4d(angles, make), "Camera"
    angles = _read(found, ["sensefly:Yaw", "sensefly:Pitch", "sensefly:Roll"])
    if angles is not None:
        return (angles[0], None if angles[1] is None else angles[1] - 90.0, angles[2]), "sensefly"
    for prefix in sorted({name.partition(":")[0] for name in found if name.endswith(":GimbalPitchDegree")}):
        angles = _read(found, [f"{prefix}:{name}" for name in _DJI_NAMES])
        if angles is not None:
            return angles, prefix
    return None


def flight_angles(found: xmp.Properties) -> tuple[Angles, str] | None:
    """The airframe's attitude and the prefix of its properties; None where there is none."""
    for prefix, names in _FLIGHT:
        angles = _read(found, [f"{prefix}:{name}" for name in names])
        if angles is not None and angles[0] is not None:
            return angles, prefix
    return None


def _read(found: xmp.Properties, names: list[str]) -> Angles | None:
    yaw, pitch, roll = (_angle(found, name) for name in names)
    return None if yaw is None and pitch is None else (yaw, pitch, roll)


def _angle(found: xmp.Properties, name: str) -> float | None:
    value = xmp.number(found, name)
    return value if value is not None and abs(value) <= 720.0 else None


def _from_pix4d(angles: Angles, make: str) -> Angles:
    """Pix4D's Camera name space counts pitch from nadir; Autel and Wingtra write it from the horizon.

    No camera looks more than 25 degrees backwards, so such a value counts from the horizon, whoever
    wrote it; this program's own are always from nadir. senseFly's roll has the other sign.
    """
    yaw, pitch, roll = angles
    maker = make.lower()
    if pitch is not None:
        from_horizon = pitch < (0.0 if maker.startswith("autel") else _FROM_HORIZON_DEG)
        pitch = pitch if from_horizon and maker != "orthoswarm" else pitch - 90.0
    if roll is not None and maker.startswith("sensefly"):
        roll = -roll
    return yaw, pitch, roll
