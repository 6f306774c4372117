"""Converts a recording in EuRoC layout to bags, to compare the readers: same pixels, same stamps.

    python3 -m venv v && v/bin/pip install rosbags==0.11.9 numpy pillow pyyaml
    v/bin/python bench/make_bags.py SEQUENCE OUT [--seconds S]

Writes OUT/one.bag (ROS 1, lz4), OUT/two (ROS 2, MCAP) and OUT/three (ROS 2, SQLite).
"""
import argparse
import csv
from pathlib import Path

import numpy as np
import yaml
from PIL import Image as Picture
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

args = argparse.ArgumentParser()
args.add_argument('sequence', type=Path)
args.add_argument('out', type=Path)
args.add_argument('--seconds', type=float, default=1e9)
args = args.parse_args()
root = args.sequence / 'mav0' if (args.sequence / 'mav0').is_dir() else args.sequence


def rows(folder):
    with open(root / folder / 'data.csv') as stream:
        return [row for row in csv.reader(stream) if row and not row[0].startswith('#')]


images, samples = rows('cam0'), rows('imu0')
first = int(images[0][0])
last = first + int(args.seconds * 1e9)
images = [row for row in images if int(row[0]) <= last]
samples = [row for row in samples if int(row[0]) <= last]
sensor = yaml.safe_load((root / 'cam0/sensor.yaml').read_text().replace('%YAML:1.0', ''))
fx, fy, cx, cy = sensor['intrinsics']
width, height = sensor['resolution']
matrix = np.array(sensor['T_BS']['data'], dtype=float).reshape(4, 4)


def quaternion(r):
    """x, y, z, w of a rotation matrix, by its largest diagonal sum."""
    w = np.sqrt(max(0.0, 1 + r[0, 0] + r[1, 1] + r[2, 2])) / 2
    x = np.copysign(np.sqrt(max(0.0, 1 + r[0, 0] - r[1, 1] - r[2, 2])) / 2, r[2, 1] - r[1, 2])
    y = np.copysign(np.sqrt(max(0.0, 1 - r[0, 0] + r[1, 1] - r[2, 2])) / 2, r[0, 2] - r[2, 0])
    z = np.copysign(np.sqrt(max(0.0, 1 - r[0, 0] - r[1, 1] + r[2, 2])) / 2, r[1, 0] - r[0, 1])
    return x, y, z, w


def messages(store, is_ros1):
    t = store.types
    Time, Header = t['builtin_interfaces/msg/Time'], t['std_msgs/msg/Header']
    V, Q = t['geometry_msgs/msg/Vector3'], t['geometry_msgs/msg/Quaternion']

    def header(ns, frame):
        stamp = Time(sec=ns // 10**9, nanosec=ns % 10**9)
        return Header(seq=0, stamp=stamp, frame_id=frame) if is_ros1 else Header(stamp=stamp, frame_id=frame)

    TransformStamped, Transform = t['geometry_msgs/msg/TransformStamped'], t['geometry_msgs/msg/Transform']
    mount = TransformStamped(header=header(first, 'imu'), child_frame_id='cam0', transform=Transform(
        translation=V(*matrix[:3, 3]), rotation=Q(*quaternion(matrix[:3, :3]))))
    yield '/tf_static', 'tf2_msgs/msg/TFMessage', first, t['tf2_msgs/msg/TFMessage'](transforms=[mount])
    arrays = dict(d=np.array(list(sensor['distortion_coefficients']) + [0.0]),
                  k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), r=np.eye(3).reshape(-1),
                  p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]))
    info = t['sensor_msgs/msg/CameraInfo'](
        header=header(first, 'cam0'), height=height, width=width, distortion_model='plumb_bob', binning_x=0, binning_y=0,
        roi=t['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False),
        **{(k.upper() if is_ros1 else k): v for k, v in arrays.items()})
    yield '/cam0/camera_info', 'sensor_msgs/msg/CameraInfo', first, info
    nine = np.zeros(9)
    events = [(int(r[0]), 0, r) for r in samples] + [(int(r[0]), 1, r) for r in images]
    for time, kind, row in sorted(events, key=lambda e: e[:2]):
        if kind == 0:
            values = [float(v) for v in row[1:7]]
            yield '/imu0', 'sensor_msgs/msg/Imu', time, t['sensor_msgs/msg/Imu'](
                header=header(time, 'imu'), orientation=Q(0.0, 0.0, 0.0, 1.0), orientation_covariance=nine,
                angular_velocity=V(*values[:3]), angular_velocity_covariance=nine,
                linear_acceleration=V(*values[3:]), linear_acceleration_covariance=nine)
        else:
            pixels = np.array(Picture.open(root / 'cam0/data' / row[1].strip()))
            channels = 1 if pixels.ndim == 2 else pixels.shape[2]
            yield '/cam0/image_raw', 'sensor_msgs/msg/Image', time, t['sensor_msgs/msg/Image'](
                header=header(time, 'cam0'), height=pixels.shape[0], width=pixels.shape[1],
                encoding='mono8' if channels == 1 else 'rgb8', is_bigendian=0, step=pixels.shape[1] * channels,
                data=pixels.reshape(-1))


args.out.mkdir(parents=True, exist_ok=True)
one, two = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
if 'tf2_msgs/msg/TFMessage' not in one.types:
    one.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', 'tf2_msgs/msg/TFMessage'))
first_writer = Writer1(args.out / 'one.bag')
first_writer.set_compression(Writer1.CompressionFormat.LZ4)
writers = [(first_writer, one, True),
           (Writer2(args.out / 'two', version=9, storage_plugin=StoragePlugin.MCAP), two, False),
           (Writer2(args.out / 'three', version=9, storage_plugin=StoragePlugin.SQLITE3), two, False)]
for writer, store, is_ros1 in writers:
    with writer:
        connections = {}
        for topic, kind, time, message in messages(store, is_ros1):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(message, kind) if is_ros1 else store.serialize_cdr(message, kind)
            writer.write(connections[topic], time, data)
