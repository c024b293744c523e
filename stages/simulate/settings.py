"""What can be asked of the simulator."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from scanloom.stages.simulate.terrain import TUNNEL_M

SMALL = {"duration_s": 8.0, "beams": 16, "columns": 512, "standstill_s": 1.0}
"""What `size: small` changes unless it is set by hand: a log of seconds for tests."""

SECOND_DAY: dict[str, Any] = {
    "seed": 1, "parking_seed": 1, "start_s": 1_760_090_000, "start_m": 950.0, "duration_s": 120.0,
}  # fmt: skip
"""The sample's second session, a day later: over the bridge, South Street westwards, round the roundabout and back, East
Street, North Street. Of the 36 cars parked on the first day 14 are gone from bays that both drives pass; 18 others came.
The field and the tunnel are out of its reach."""


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    size: Literal["sample", "small"] = Field(
        "sample",
        description="sample: about three minutes and 1.2 km; small: some seconds with a coarse LiDAR",
    )
    seed: int = Field(0, ge=0, le=2**31, description="seed of all sensor noise and of traffic")
    town_seed: int = Field(0, ge=0, le=2**31, description="seed of the town: houses, trees, poles")
    parking_seed: int = Field(
        0, ge=0, le=2**31, description="seed of the parked cars; another one is another day"
    )
    start_s: int = Field(
        1_760_000_000, ge=0, le=4_000_000_000, description="time of the first sample since 1970, s"
    )
    duration_s: float = Field(180.0, ge=1.0, le=7200.0, description="length of the log, s")
    route: Literal["town", "roundabout", "estate"] = Field(
        "town",
        description="town: the whole lap, again and again; roundabout: circles of 54 m, a tiny loop; estate: another world, "
        "with parallel streets that look alike and one that repeats itself",
    )
    start_m: float = Field(0.0, ge=0.0, le=5000.0, description="place on the route where the drive starts, m")
    tunnel_m: float = Field(
        TUNNEL_M,
        ge=40.0,
        le=2000.0,
        description="length of the tunnel, m; what lies beyond it moves; one over 100 m has signs, and emergency stations in niches",
    )
    standstill_s: float = Field(2.5, ge=0.0, le=60.0, description="time at rest before the drive, s")
    top_speed_m_s: float = Field(13.0, ge=1.0, le=30.0, description="speed limit outside the town, m/s")
    traffic: bool = Field(True, description="cars, a truck, a cyclist and pedestrians move about")
    dust_per_m: float = Field(
        0.25, ge=0.0, le=5.0, description="extinction of fresh dust behind the truck, 1/m"
    )
    busy: bool = Field(
        False,
        description="more traffic: a car that waits at a light and leaves, one that comes to park, one that leaves its bay, "
        "a bus, a cyclist by the kerb, people who stand and walk on, with a dog and with a pram along a wall",
    )
    snow_per_m: float = Field(
        0.0,
        ge=0.0,
        le=0.5,
        description="snowfall: chance of a return from a flake in a metre of ray, at the range where flakes are seen best, "
        "1/m; 0.0006 is light (0.5 % of the returns in streets, 1 % in the open), 0.0035 middle (3 and 6 %), 0.012 heavy "
        "(9 and 19 %)",
    )
    dust_clouds: float = Field(
        0.0,
        ge=0.0,
        le=20.0,
        description="clouds of dust that wind and wheels raise near the vehicle, on streets and field, and that drift: "
        "extinction of fresh dust, 1/m; 0.2 is light (about 3 % of the returns), 0.5 middle (10 %), 1.5 heavy (24 %; "
        "some scans see little else)",
    )
    spray_per_m: float = Field(
        0.0,
        ge=0.0,
        le=5.0,
        description="spray behind wheels on a wet road: extinction at 8 m/s, 1/m; 0.3 is light, 1 middle, 3 heavy",
    )

    beams: Literal[16, 32, 64] = Field(32, description="beams of the LiDAR")
    rate_hz: Literal[10, 20] = Field(10, description="sweeps per second, Hz")
    columns: int = Field(1024, ge=64, le=4096, description="firings per sweep")
    low_deg: float = Field(-25.0, ge=-60.0, le=0.0, description="elevation of the lowest beam, deg")
    high_deg: float = Field(15.0, ge=0.0, le=60.0, description="elevation of the highest beam, deg")
    max_range_m: float = Field(100.0, ge=10.0, le=300.0, description="range beyond which nothing is seen, m")
    range_noise_m: float = Field(0.02, ge=0.0, le=0.5, description="standard deviation of a range, m")
    beam_range_error_m: float = Field(
        0.012,
        ge=0.0,
        le=0.2,
        description="standard deviation of the zero of a beam's range, unknown to the user, m",
    )
    beam_angle_error_deg: float = Field(
        0.04,
        ge=0.0,
        le=1.0,
        description="standard deviation of a beam's direction, each axis, unknown to the user, deg",
    )
    dropout: float = Field(0.02, ge=0.0, le=0.9, description="share of returns lost by chance")
    outliers: float = Field(2e-4, ge=0.0, le=0.1, description="share of returns at a wrong range")

    gyro_noise_rad_s: float = Field(0.002, ge=0.0, le=0.1, description="white noise of a gyro sample, rad/s")
    gyro_bias_rad_s: float = Field(
        0.004, ge=0.0, le=0.1, description="standard deviation of the gyro bias, rad/s"
    )
    gyro_walk_rad_s: float = Field(2e-4, ge=0.0, le=0.01, description="growth of the gyro bias in 1 s, rad/s")
    accel_noise_m_s2: float = Field(
        0.03, ge=0.0, le=1.0, description="white noise of an accelerometer sample, m/s2"
    )
    accel_bias_m_s2: float = Field(0.05, ge=0.0, le=1.0, description="standard deviation of its bias, m/s2")
    accel_walk_m_s2: float = Field(1e-3, ge=0.0, le=0.1, description="growth of its bias in 1 s, m/s2")
    wheel_scale: float = Field(0.01, ge=-0.2, le=0.2, description="scale error of the wheel speed")
    wheel_noise_m_s: float = Field(0.02, ge=0.0, le=1.0, description="white noise of the wheel speed, m/s")
    wheel_slip: float = Field(
        0.25, ge=0.0, le=1.0, description="excess of the wheel speed at the height of a slip"
    )
    imu_clock_s: float = Field(
        0.003, ge=-0.1, le=0.1, description="error of the clock that stamps the IMU, s"
    )
    wheel_clock_s: float = Field(0.015, ge=-0.1, le=0.1, description="delay of the wheel speed on its bus, s")
    stamp_jitter_s: float = Field(1e-4, ge=0.0, le=0.01, description="error of IMU and wheel stamps, s")

    cameras: int = Field(
        0, ge=0, le=3, description="cameras on board: front, left, right; 0 leaves the log without images"
    )
    camera_rate_hz: float = Field(2.0, ge=0.1, le=30.0, description="images of each camera per second, Hz")
    camera_width_px: int = Field(640, ge=64, le=4096, description="width of an image, px")
    camera_height_px: int = Field(400, ge=48, le=4096, description="height of an image, px")
    lens: Literal["radial-tangential", "equidistant"] = Field(
        "radial-tangential", description="kind of lens of all cameras"
    )
    exposure_noise: float = Field(
        0.12,
        ge=0.0,
        le=1.0,
        description="standard deviation of the exposure about what the image asks for, as a share of it",
    )
    readout_s: float = Field(
        0.0,
        ge=0.0,
        le=0.1,
        description="time from the first row of an image to the last, s; 0 is a global shutter",
    )
    camera_clock_s: float = Field(
        0.0, ge=-1.0, le=1.0, description="how much later the cameras' stamps are than they should be, s"
    )
    camera_turned_deg: float = Field(
        0.0,
        ge=0.0,
        le=30.0,
        description="how far each camera was turned about some axis since the log's tf was true, deg",
    )
    camera_error_deg: float = Field(
        0.03,
        ge=0.0,
        le=5.0,
        description="error of the log's tf of a camera, each axis, standard deviation, deg",
    )
    camera_error_m: float = Field(
        0.003, ge=0.0, le=0.5, description="the same of its place, each axis, standard deviation, m"
    )
    jpeg_quality: int = Field(90, ge=10, le=100, description="quality of the images as JPEG")
    sun_elevation_deg: float = Field(42.0, ge=5.0, le=90.0, description="height of the sun, deg")
    sun_azimuth_deg: float = Field(
        205.0, ge=0.0, le=360.0, description="where the sun stands, clockwise from north, deg"
    )
    sun_share: float = Field(
        0.5,
        ge=0.0,
        le=0.95,
        description="share of the light on level ground that comes from the sun, the rest from the sky; 0 is overcast",
    )

    gnss: bool = Field(True, description="a GNSS receiver is on board")
    gnss_multipath_m: float = Field(
        4.0, ge=0.0, le=50.0, description="size of the lie between high houses, m"
    )
    gnss_outage_s: float = Field(
        0.0,
        ge=0.0,
        le=3600.0,
        description="the receiver finds no position for so long, s; the first ones after it are off by metres and called good",
    )
    gnss_outage_at_s: float = Field(
        0.0, ge=0.0, le=7200.0, description="the outage begins so long after the start, s"
    )
    gnss_lies: float = Field(
        0.0, ge=0.0, le=1.0, description="share of fixes that are off by 5 to 30 m and called good"
    )
    gnss_clock_s: float = Field(
        0.0, ge=-10.0, le=10.0, description="error of the clock that stamps the fixes, s"
    )
    gnss_lever_arm_known: bool = Field(True, description="the log tells where on the vehicle the antenna is")
    latitude_deg: float = Field(
        48.137, ge=-80.0, le=80.0, description="WGS84 latitude of the town's origin, deg"
    )
    longitude_deg: float = Field(
        11.576, ge=-180.0, le=180.0, description="WGS84 longitude of the town's origin, deg"
    )
    height_m: float = Field(
        560.0, ge=-500.0, le=9000.0, description="ellipsoidal height of the town's origin, m"
    )

    @model_validator(mode="before")
    @classmethod
    def _small(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("size") == "small":
            return {**SMALL, **given}
        return given
