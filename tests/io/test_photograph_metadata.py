"""Packets as drones of several makes write them (names and numbers of real ones): positions, attitudes, times."""

from datetime import datetime

import numpy as np
import pytest
from PIL import Image

from jaxphoto.georeferencing.camera_attitude import USUAL_SIGMA_DEG, level_from_belly, level_from_gimbal
from jaxphoto.io.photographs import drone_record, read_photograph, time_of_exposure, xmp_fields

DJI = """<rdf:Description rdf:about="DJI Meta Data" drone-dji:GpsStatus="RTK" drone-dji:AltitudeType="RtkAlt"
 drone-dji:GpsLatitude="22.6939917" drone-dji:AbsoluteAltitude="+139.231" drone-dji:RelativeAltitude="+80.012"
 drone-dji:GimbalRollDegree="+180.00" drone-dji:GimbalYawDegree="-92.70" drone-dji:GimbalPitchDegree="-90.00"
 drone-dji:FlightRollDegree="+1.30" drone-dji:FlightYawDegree="+87.20" drone-dji:FlightPitchDegree="-4.30"
 drone-dji:CamReverse="0" drone-dji:GimbalReverse="0" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01174"
 drone-dji:RtkStdLat="0.01262" drone-dji:RtkStdHgt="0.02684" drone-dji:UTCAtExposure="2022-07-23T07:12:22.872778"/>"""
AUTEL = """<rdf:Description rdf:about="DJI Meta Data" drone:AbsoluteAltitude="+312.40" drone:RelativeAltitude="+54.10"
 drone:GimbalRollDegree="+0.00" drone:GimbalYawDegree="+14.20" drone:GimbalPitchDegree="-89.90"/>"""
SENSEFLY = """<Camera:Roll>-6.932620</Camera:Roll><Camera:Pitch>2.5</Camera:Pitch><Camera:Yaw>-146.946594</Camera:Yaw>
<Camera:GPSXYAccuracy>0.024764</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>0.036845</Camera:GPSZAccuracy>
<Camera:IMURollAccuracy>5</Camera:IMURollAccuracy><Camera:IMUPitchAccuracy>5</Camera:IMUPitchAccuracy>
<Camera:IMUYawAccuracy>10</Camera:IMUYawAccuracy><CRSInfo:VERTCRS>EGM96</CRSInfo:VERTCRS>"""
PARROT = """<rdf:Description Camera:GPSXYAccuracy="845389/2097152" Camera:GPSZAccuracy="5117051/8388608"
 Camera:Roll="-0.041258" Camera:Pitch="38.011101" Camera:Yaw="146.781036" drone-parrot:CameraRollDegree="-0.052789"
 drone-parrot:CameraPitchDegree="-51.988888" drone-parrot:CameraYawDegree="146.848038"/>"""
SKYDIO = """<rdf:Description drone-skydio:AbsoluteAltitude="1034.441910" drone-skydio:Latitude="40.1">
<drone-skydio:CameraOrientationFLU drone-skydio:Roll="1" drone-skydio:Pitch="2" drone-skydio:Yaw="3"/>
<drone-skydio:CameraOrientationNED drone-skydio:Roll="0.186841" drone-skydio:Pitch="-7.468572"
 drone-skydio:Yaw="101.5"/></rdf:Description>"""
SKYDIO_NEW = """<drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Yaw>101.5</drone-skydio:Yaw>
<drone-skydio:Pitch>-7.468572</drone-skydio:Pitch><drone-skydio:Roll>0.186841</drone-skydio:Roll>
</drone-skydio:CameraOrientationNED><drone-skydio:CameraOrientationFLU rdf:parseType="Resource">
<drone-skydio:Yaw>9</drone-skydio:Yaw></drone-skydio:CameraOrientationFLU>"""


def record(packet):
    return drone_record(xmp_fields(packet))


def test_dji_with_corrections():
    found = record(DJI)
    assert (found.altitude_m, found.above_takeoff_m, found.heights, found.fix) == (
        139.231,
        80.012,
        "ellipsoid",
        "fixed",
    )
    assert found.sigma_m == (0.01174, 0.01262, 0.02684) and found.aircraft_deg == (1.3, -4.3, 87.2)
    assert found.utc == datetime(2022, 7, 23, 7, 12, 22, 872778)
    np.testing.assert_allclose(found.attitude.level_from_camera, level_from_gimbal(87.3, -90, 0), atol=1e-12)


@pytest.mark.parametrize(("flag", "fix"), [("0", "unknown"), ("16", "single"), ("34", "float"), ("52", "fixed")])
def test_the_flag_says_the_solution(flag, fix):
    assert record(DJI.replace('RtkFlag="50"', f'RtkFlag="{flag}"')).fix == fix


def test_without_corrections_nobody_says_what_the_height_is_above():
    plain = DJI.replace("RtkAlt", "GpsFusionAlt").replace('RtkFlag="50"', 'RtkFlag="0"')
    found = record(plain)
    # The standard deviations of a receiver's corrections, which it had not.
    assert found.heights == "unknown" and found.sigma_m is None
    assert record(DJI.replace('GimbalReverse="0"', 'GimbalReverse="1"')).attitude is None


def test_other_makes():
    found = record(AUTEL)
    assert (found.altitude_m, found.above_takeoff_m, found.heights) == (312.4, 54.1, "unknown")
    np.testing.assert_allclose(found.attitude.level_from_camera, level_from_gimbal(14.2, -89.9, 0))
    found = record(SENSEFLY)
    assert found.sigma_m == (0.024764, 0.024764, 0.036845) and found.heights == "geoid"
    assert found.attitude.sigma_deg == (5, 5, 10)
    np.testing.assert_allclose(found.attitude.level_from_camera, level_from_belly(-146.946594, 2.5, -6.93262))
    found = record(PARROT)
    assert found.sigma_m == pytest.approx((0.40311, 0.40311, 0.61), abs=1e-5)
    np.testing.assert_allclose(found.attitude.level_from_camera, level_from_gimbal(146.848038, -51.988888, -0.052789))
    for packet in (SKYDIO, SKYDIO_NEW):
        found = record(packet)
        np.testing.assert_allclose(found.attitude.level_from_camera, level_from_gimbal(101.5, -7.468572, 0.186841))
        assert found.attitude.sigma_deg == USUAL_SIGMA_DEG
    found = record(SKYDIO.replace(" drone-skydio:Lat", ' drone-skydio:RelativeAltitude="34.5" drone-skydio:Lat'))
    assert (found.altitude_m, found.above_takeoff_m, found.latitude_longitude_deg) == (1034.44191, 34.5, None)


@pytest.mark.parametrize(
    "packet",
    [
        DJI.replace('"22.6939917"', '"-47.25" drone-dji:GpsLongitude="+15.5"'),
        DJI.replace('"22.6939917"', '"-47.25" drone-dji:GpsLongtitude="15.5"'),
        SKYDIO.replace('Latitude="40.1"', 'Latitude="-47.25" drone-skydio:Longitude="15.5"'),
    ],
)
def test_positions_of_packets_alone(tmp_path, packet):
    picture = Image.new("L", (40, 30))
    picture.save(tmp_path / "a.jpg", xmp=packet.encode())
    found = read_photograph(tmp_path / "a.jpg").gps
    assert found[:2] == (-47.25, 15.5) and found.altitude_m == record(packet).altitude_m
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "S", 2: (47, 30, 0), 3: "E", 4: (15, 30, 0)})
    picture.save(tmp_path / "b.jpg", xmp=packet.encode(), exif=exif)
    assert read_photograph(tmp_path / "b.jpg").gps.latitude_deg == -47.5


def test_angles_that_are_none_are_no_attitude():
    for given, instead in (("-90.00", "nan"), ("-90.00", "1e99"), ("-92.70", ""), ("+180.00", "1/0")):
        assert record(DJI.replace(given, instead)).attitude is None


def test_times_of_exposure():
    exif = {0x9003: "2025:05:20 10:12:34\0", 0x9291: "25"}
    assert time_of_exposure(exif, None)[:] == (
        time_of_exposure(exif | {0x9291: ""}, None).clock_s + 0.25,
        0.01,
        None,
    )
    assert time_of_exposure(exif | {0x9011: "-03:30"}, None).ahead_of_utc_s == -12600
    assert time_of_exposure(exif, datetime(1980, 1, 13, 0, 0, 1, 500000))[:] == (604801.5, 1e-6, 0.0)
    for wrong in ({0x9003: "0000:00:00 00:00:00"}, {0x9003: 7}, {}):
        assert time_of_exposure(wrong, None) is None
