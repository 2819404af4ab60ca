"""Camera files in the notations of programs and SDKs, all of one camera where not stated."""

ZED = """\
[LEFT_CAM_HD]
fx=700.1
fy=700.2
cx=642.5
cy=355.1

[RIGHT_CAM_HD]
fx=701
fy=701
cx=640.5
cy=360.1

[LEFT_CAM_VGA]
fx=525.25
fy=526.5
cx=319.5
cy=239.25

[RIGHT_CAM_VGA]
fx=526
fy=526
cx=319
cy=239

[LEFT_DISTO]
k1=0.1
k2=-0.02
p1=0.001
p2=0.00001
k3=0.03

[RIGHT_DISTO]
k1=-0.17
k2=0.026
k3=0

[STEREO]
Baseline=119.9
TY=0.1
TZ=-0.3
CV_VGA=0.003
RX_VGA=-0.002
RZ_VGA=0.0001
"""
OST = """\
# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
525.25 0.000000 319.5
0.000000 526.5 239.25
0.000000 0.000000 1.000000

distortion
0.1 -0.02 0.001 0.00001 0.03

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
500.25 0.000000 318.5 0.000000
0.000000 501.5 238.25 0.000000
0.000000 0.000000 1.000000 0.000000
"""
ENUMERATED = """\
Device info:
    Name                          : \tIntel RealSense D405
    Serial Number                 : \t123456789012

Stream Profiles supported by Stereo Module
 Supported modes:
    stream       resolution      fps       format
    Color        1280x720        @ 30Hz    RGB8
    Color        640x480         @ 30Hz    RGB8

Intrinsic Parameters:

 Intrinsic of "Color" / 1280x720 / {YUYV/RGB8}
  Width:      \t1280
  Height:     \t720
  PPX:        \t639.5
  PPY:        \t359.5
  Fx:         \t600.5
  Fy:         \t600.25
  Distortion: \tInverse Brown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0
  FOV (deg):  \t93.6 x 61.9

 Intrinsic of "Color" / 640x480 / {YUYV/RGB8}
  Width:      \t640
  Height:     \t480
  PPX:        \t319.5
  PPY:        \t239.25
  Fx:         \t525.25
  Fy:         \t526.5
  Distortion: \tBrown Conrady
  Coeffs:     \t0.1  \t-0.02  \t0.001  \t0.00001  \t0.03
  FOV (deg):  \t62.7 x 49.0

Extrinsic from "Color"    To      "Depth" :
 Rotation Matrix:
   0.99     0.01     0
  -0.01     0.99     0
   0        0        1

 Translation Vector: 0.015  0  0.0003

Extrinsic from "Depth"    To      "Color" :
 Rotation Matrix:
   0.99    -0.01     0
   0.01     0.99     0
   0        0        1

 Translation Vector: -0.015  0  -0.0003
"""
PRINTED = (
    "[ 640x480  p[319.5 239.25]  f[525.25 526.5]  Brown Conrady"
    " [0.1 -0.02 0.001 1e-05 0.03] ]\n"
)
STRUCT = (
    "width: 640, height: 480, ppx: 319.5, ppy: 239.25, fx: 525.25, fy: 526.5,"
    " model: Brown Conrady, coeffs: [0.1, -0.02, 0.001, 1e-05, 0.03]\n"
)
KINECT = """\
===== Device 0: 000123191512 =====
resolution width: 640
resolution height: 480
principal point x: 319.5
principal point y: 239.25
focal length x: 525.25
focal length y: 526.5
radial distortion coefficients:
k1: 0.1
k2: -0.02
k3: 0.03
k4: 0
k5: 0
k6: 0
center of distortion in Z=1 plane, x: 0
center of distortion in Z=1 plane, y: 0
tangential distortion coefficient x: 0.001
tangential distortion coefficient y: 0.00001
metric radius: 1.7
"""
MRCAL = """\
# generated on 2026-01-02 03:04:05 with   mrcal-calibrate-cameras --lensmodel LENSMODEL_OPENCV5
{
    'lensmodel':  'LENSMODEL_OPENCV5',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 525.25, 526.5, 319.5, 239.25, 0.1, -0.02, 0.001, 1e-05, 0.03,],

    'valid_intrinsics_region': [
    [ 10, 10 ],
    [ 630, 10 ],
    [ 630, 470 ],
    [ 10, 10 ],
    ],

    # extrinsics are rt_fromref
    'extrinsics': [ 0, 0, 0, 0, 0, 0,],

    'imagersize': [ 640, 480,],
    'icam_intrinsics': 1,
    'optimization_inputs': b'TGF0aW4=',
}
"""
COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
1 FULL_OPENCV 640 480 525.25 526.5 320 239.75 0.1 -0.02 0.001 0.00001 0.03 0 0 0
2 PINHOLE 1280 720 900 900 640 360
"""
METASHAPE = """\
<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0">
  <chunk>
    <sensors>
      <sensor id="0" label="unknown" type="frame">
        <resolution width="640" height="480"/>
        <property name="layer_index" value="0"/>
        <bands><band label="Red"/></bands>
        <calibration type="frame" class="initial">
          <resolution width="640" height="480"/>
          <f>600</f>
        </calibration>
        <calibration type="frame" class="adjusted">
          <resolution width="640" height="480"/>
          <f>526.5</f>
          <cx>0.0</cx>
          <cy>-0.25</cy>
          <b1>-1.25</b1>
          <k1>0.1</k1>
          <k2>-0.02</k2>
          <k3>0.03</k3>
          <p1>0.00001</p1>
          <p2>0.001</p2>
        </calibration>
      </sensor>
    </sensors>
  </chunk>
</document>
"""
KITTI = """\
calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 6.400000e+02 4.800000e+02
K_00: 5.2525e+02 0 3.195e+02 0 5.265e+02 2.3925e+02 0 0 1
D_00: 0.1 -0.02 0.001 0.00001 0.03
R_00: 1 0 0 0 1 0 0 0 1
T_00: 2.573699e-16 -1.059758e-16 1.614870e-16
S_rect_00: 1242 375
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 7.2e+02 0 6.0e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
"""
VALUES = """\
fx 525.25
fy 526.5
cx 319.5
cy 239.25
k1 0.1
k2 -0.02
p1 0.001
p2 1e-5
k3 0.03
"""
ALL = {
    "zed": ZED.replace("RIGHT_CAM_VGA]\nfx=526", "RIGHT_CAM_X]\nfx=1526")
    .replace("cx=319\n", "cx=1000\n"),
    "ost.txt": OST,
    "rs-enumerate-devices": ENUMERATED,
    "pyrealsense2": PRINTED,
    "pyrealsense2, old": STRUCT,
    "k4a": KINECT,
    "mrcal": MRCAL,
    "colmap": COLMAP,
    "metashape": METASHAPE,
    "kitti": KITTI,
    "words": VALUES,
    "equals": VALUES.replace(" ", " = "),
}  # fmt: skip
