"""From logs to a tiled, georeferenced map: the whole flow, one line a stage."""

from __future__ import annotations

from scanloom.pipeline.node import Node, node
from scanloom.schemas.base import Base, BaseLog
from scanloom.schemas.cameras import CameraCheck, Cameras, Images
from scanloom.schemas.changes import ChangeFiles, Changes
from scanloom.schemas.clean import ClassCounts, Cleared, FinalLabels, Rays
from scanloom.schemas.evaluation import ErrorTrack, Metrics, PictureFiles, ReportFiles
from scanloom.schemas.loops import Loops, Places
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, Labels, Scans
from scanloom.schemas.session import RawLog, Session, TruthLog
from scanloom.schemas.tiles import (
    Colours,
    MapFiles,
    Overview,
    Paint,
    Piece,
    RemovedTile,
    Tile,
    TileFiles,
    TileIndex,
)
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.schemas.windows import Track, TrackEnds, Window
from scanloom.stages.base import base
from scanloom.stages.camera_check import camera_check
from scanloom.stages.changes import changes
from scanloom.stages.clean import clean, rays, relabel
from scanloom.stages.colour import brightness, colour
from scanloom.stages.denoise import denoise
from scanloom.stages.deskew import deskew
from scanloom.stages.evaluation import evaluation
from scanloom.stages.fusion import fusion
from scanloom.stages.images import images
from scanloom.stages.ingest import ingest
from scanloom.stages.loops.closing import loops
from scanloom.stages.loops.places import places
from scanloom.stages.objects import objects
from scanloom.stages.odometry import odometry
from scanloom.stages.odometry.tracking import track
from scanloom.stages.odometry.windows import windows
from scanloom.stages.report import picture, report
from scanloom.stages.sensors import sensors
from scanloom.stages.simulate import simulate
from scanloom.stages.tiling import overview, tiles, tiling
from scanloom.stages.truth import truth

SIMULATED = "simulated"
"""Tag of a session that the simulator writes instead of a vehicle."""

# fmt: off
NODES: tuple[Node, ...] = (
    node("simulate",   simulate,   per="session", reads=(),                                    writes=(RawLog, TruthLog), only=SIMULATED),
    node("base",       base,       per="session", reads=(BaseLog,),                            writes=Base),
    node("truth",      truth,      per="session", reads=(TruthLog,),                           writes=Truth),
    node("ingest",     ingest,     per="session", reads=(RawLog,),                             writes=(Scans, Imu, Gnss, Wheel, Session)),
    node("images",     images,     per="session", reads=(RawLog, Session),                     writes=(Images, Cameras)),
    node("sensors",    sensors,    per="session", reads=(Scans, Session, Imu, Wheel),          writes=SensorCheck),
    node("deskew",     deskew,     per="chunk",   reads=(Scans, Session, Imu, Wheel, SensorCheck), writes=Deskewed),
    node("denoise",    denoise,    per="chunk",   reads=(Deskewed, Session, Imu, Wheel, SensorCheck), writes=Labels),
    node("windows",    windows,    per="session", reads=(Scans,),                              writes=Window, settings="odometry"),
    node("track",      track,      per="window",  reads=(Window, Deskewed, Labels, Session, Imu, Wheel, SensorCheck), writes=(Track, TrackEnds), settings="odometry"),
    node("odometry",   odometry,   per="session", reads=(Deskewed, Labels, Session, Imu, Wheel, SensorCheck, Track, TrackEnds), writes=Odometry),
    node("camera_check", camera_check, per="session", reads=(Images, Cameras, Deskewed, Labels, Odometry), writes=CameraCheck),
    node("objects",    objects,    per="session", reads=(Deskewed, Labels, Session, Odometry), writes=ObjectTracks),
    node("places",     places,     per="chunk",   reads=(Deskewed, Labels, Odometry),          writes=Places),
    node("loops",      loops,      per="map",     reads=(Deskewed, Labels, Odometry, Places),  writes=Loops),
    node("fusion",     fusion,     per="map",     reads=(Session, Odometry, Loops, Gnss, Imu, Wheel, SensorCheck, Base), writes=(Poses, Graph)),
    node("rays",       rays,       per="chunk",   reads=(Deskewed, Labels, ObjectTracks, Poses),             writes=Rays),
    node("clean",      clean,      per="tile",    reads=(Rays,),                               writes=Cleared),
    node("relabel",    relabel,    per="chunk",   reads=(Deskewed, Labels, ObjectTracks, Cleared, Poses), writes=(FinalLabels, ClassCounts)),
    node("tiling",     tiling,     per="chunk",   reads=(Deskewed, FinalLabels, Poses),        writes=Piece),
    node("colour",     colour,     per="footage", reads=(Images, Cameras, Poses, ObjectTracks, Piece), writes=Paint),
    node("brightness", brightness, per="session", reads=(Paint,),                              writes=Colours),
    node("changes",    changes,    per="map",     reads=(Base, Poses, Deskewed, FinalLabels, Piece), writes=(Changes, ChangeFiles)),
    node("tiles",      tiles,      per="tile",    reads=(Piece, Colours),                        writes=(Tile, RemovedTile, TileFiles)),
    node("overview",   overview,   per="map",     reads=(Tile, RemovedTile),                   writes=(TileIndex, Overview, MapFiles)),
    node("evaluation", evaluation, per="map",     reads=(Session, Truth, Odometry, Poses, Loops, Graph, Gnss, Tile, SensorCheck, ClassCounts, RemovedTile, CameraCheck), writes=(Metrics, ErrorTrack)),
    node("picture",    picture,    per="map",     reads=(Poses, Loops, Graph, TileIndex, Tile, RemovedTile), writes=PictureFiles),
    node("report",     report,     per="map",     reads=(Session, Metrics, ErrorTrack, Odometry, Poses, Loops, Graph, TileIndex, PictureFiles, SensorCheck, Changes, ObjectTracks, ClassCounts, Cameras, CameraCheck), writes=ReportFiles),
)
# fmt: on
