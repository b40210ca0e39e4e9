"""MJCF files with the dimensions of well-known arms, and their poses in MuJoCo."""

from typing import Any

import mujoco
import numpy as np

from dhcal_pin import se3

UR5E = """<mujoco model="ur5e">
  <compiler angle="radian" autolimits="true" meshdir="assets"/>
  <default>
    <default class="ur5e">
      <joint axis="0 1 0" range="-6.28319 6.28319" armature="0.1"/>
      <default class="visual"><geom contype="0" conaffinity="0" density="0"/></default>
      <default class="eef"><geom pos="0 0 0.05" size="0.01"/><site size="0.001" rgba="0.5 0.5 0.5 0.3"/></default>
    </default>
  </default>
  <worldbody>
    <light name="spotlight" mode="targetbodycom" target="wrist_2_link" pos="0 -1 2"/>
    <body name="base" quat="0 0 0 -1" childclass="ur5e">
      <inertial mass="4.0" pos="0 0 0" diaginertia="0.00443333156 0.00443333156 0.0072"/>
      <body name="shoulder_link" pos="0 0 0.163">
        <inertial mass="3.7" pos="0 0 0" diaginertia="0.0102675 0.0102675 0.00666"/>
        <joint name="shoulder_pan_joint" class="ur5e" axis="0 0 1"/>
        <geom size="0.05 0.05" type="cylinder" class="visual"/>
        <body name="upper_arm_link" pos="0 0.138 0" quat="1 0 1 0">
          <inertial mass="8.393" pos="0 0 0.2125" diaginertia="0.133886 0.133886 0.0151074"/>
          <joint name="shoulder_lift_joint"/>
          <body name="forearm_link" pos="0 -0.131 0.425">
            <inertial mass="2.275" pos="0 0 0.196" diaginertia="0.0311796 0.0311796 0.004095"/>
            <joint name="elbow_joint" range="-3.1415 3.1415"/>
            <body name="wrist_1_link" pos="0 0 0.392" quat="1 0 1 0">
              <inertial mass="1.219" pos="0 0.127 0" diaginertia="0.0025599 0.0025599 0.0021942"/>
              <joint name="wrist_1_joint"/>
              <body name="wrist_2_link" pos="0 0.127 0">
                <inertial mass="1.219" pos="0 0 0.1" diaginertia="0.0025599 0.0025599 0.0021942"/>
                <joint name="wrist_2_joint" axis="0 0 1"/>
                <body name="wrist_3_link" pos="0 0 0.1">
                  <inertial mass="0.1889" pos="0 0.0771683 0" quat="1 0 0 1"
                    diaginertia="0.000132134 9.90863e-05 9.90863e-05"/>
                  <joint name="wrist_3_joint"/>
                  <geom class="eef"/>
                  <site name="attachment_site" pos="0 0.1 0" quat="-1 1 0 0" class="eef"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="pan" joint="shoulder_pan_joint" kp="2000"/></actuator>
  <keyframe><key name="home" qpos="-1.57 -1.57 1.57 -1.57 -1.57 0" ctrl="-1.57"/></keyframe>
</mujoco>
"""

PANDA = """<mujoco model="panda">
  <compiler angle="radian" meshdir="assets" autolimits="true"/>
  <option integrator="implicitfast"/>
  <default>
    <default class="panda">
      <joint armature="0.1" damping="1" axis="0 0 1" range="-2.8973 2.8973"/>
      <default class="finger"><joint axis="0 1 0" type="slide" range="0 0.04"/></default>
    </default>
  </default>
  <worldbody>
    <body name="link0" childclass="panda">
      <body name="link1" pos="0 0 0.333"><joint name="joint1"/><geom size="0.06"/>
        <body name="link2" quat="1 -1 0 0"><joint name="joint2" range="-1.7628 1.7628"/><geom size="0.06"/>
          <body name="link3" pos="0 -0.316 0" quat="1 1 0 0"><joint name="joint3"/><geom size="0.06"/>
            <body name="link4" pos="0.0825 0 0" quat="1 1 0 0"><joint name="joint4" range="-3.0718 -0.0698"/><geom size="0.06"/>
              <body name="link5" pos="-0.0825 0.384 0" quat="1 -1 0 0"><joint name="joint5"/><geom size="0.06"/>
                <body name="link6" quat="1 1 0 0"><joint name="joint6" range="-0.0175 3.7525"/><geom size="0.06"/>
                  <body name="link7" pos="0.088 0 0" quat="1 1 0 0"><joint name="joint7"/><geom size="0.05"/>
                    <body name="hand" pos="0 0 0.107" quat="0.9238795 0 0 -0.3826834"><geom size="0.04"/>
                      <body name="left_finger" pos="0 0 0.0584"><joint name="finger_joint1" class="finger"/><geom size="0.01"/></body>
                      <body name="right_finger" pos="0 0 0.0584" quat="0 0 0 1"><joint name="finger_joint2" class="finger"/><geom size="0.01"/></body>
                    </body></body></body></body></body></body></body></body>
    </body>
  </worldbody>
  <equality><joint joint1="finger_joint1" joint2="finger_joint2"/></equality>
</mujoco>
"""

SCARA = """<?xml version='1.0' encoding='utf-8'?>
<!-- A SCARA of 850 mm: angles in degrees, the default of MuJoCo. -->
<mujoco model='scara'>
  <worldbody>
    <geom type='plane' size='1 1 .1'/>
    <body name='column' pos='0 0 .34'>
      <joint name='shoulder' range='-130 130' ref='5'/> <geom size='.05'/>
      <body name='arm' pos='.45 0 0'>
        <joint name='elbow' range='-145 145'/> <geom size='.05'/>
        <body name='quill' pos='.4 0 .05' euler='180 0 0'>
          <joint name='lift' type='slide' range='0 .2' ref='0.02'/> <geom size='.02'/>
          <body name='flange' pos='0 0 .18'>
            <joint name='roll' axis='0 0 3' range='-360 360'/> <geom size='.01'/>
            <site name='tool0' pos='0 0 .02'/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

XARM = """<mujoco model="xarm6">
  <compiler angle="radian" eulerseq="XYZ"/>
  <worldbody>
    <body name="link_base">
      <body name="link1" pos="0 0 0.267"><joint name="joint1"/><inertial pos="0 0 0" mass="2.1" fullinertia=".01 .02 .015 1e-4 0 0"/>
        <body name="link2" euler="-1.5708 0 0"><joint name="joint2" pos="0 0 0"/><inertial pos="0.1 0 0" mass="1.9" diaginertia=".01 .01 .01"/>
          <body name="link3" pos="0.053 -0.2845 0"><joint name="joint3"/><inertial pos="0.1 0 0" mass="1.7" diaginertia=".01 .01 .01"/>
            <body pos="0.0775 0.3425 0" euler="-1.5708 0 0" name="link4"><joint name="joint4"/><inertial pos="0 0 0" mass="1.3" diaginertia=".01 .01 .01"/>
              <body name="link5" euler="1.5708 0 0"><joint name="joint5"/><inertial pos="0 0 0" mass="1.0" diaginertia=".01 .01 .01"/>
                <body name="link6" pos="0.076 0.097 0" euler="-1.5708 0 0"><joint name="joint6"/><inertial pos="0 0 0" mass="0.1" diaginertia=".001 .001 .001"/>
                </body></body></body></body></body></body>
    </body>
  </worldbody>
</mujoco>
"""

# All forms of orientations, anchors of joints, frames, classes, and a line of DOS.
BENCH = """<mujoco>\r
<compiler angle="degree" eulerseq="zYx"/>
<default><joint axis="0 2 0"/><default class="s"><joint type="slide" axis="1 0 0" range="-0.2 0.3"/></default></default>
<worldbody>
<frame pos="0.1 0 0" euler="10 20 30">
<body pos = "0 0 .3" name="a" euler='30 -20 10'><joint name="j1" pos="0.05 0.1 -0.02" axis="0.1 0.2 3" ref="15"/><geom size="0.1"/>
 <body name="b" pos="0.4 0 0" axisangle="1 2 3 40"><joint name="j2" class="s" ref="0.05" pos="1 2 3"/><geom size="0.1"/>
  <frame quat="1 0 0 1" childclass="s"><body name="c" xyaxes="0 1 0 -1 0.2 0"><joint name="j3" class="main"/><geom size="0.1"/>
   <body name="d" pos="0.1 0.1 0.1" zaxis="1 2 -3" childclass="main"><joint name="j4" range="-90 180" pos="0 0 0.1"/><geom size="0.1"/>
   <body name="e" pos="0.1 0 0.1" zaxis="0 0 -1"><joint name="j5" axis="1 0 0"/><geom size="0.1"/>
   <frame pos="0 0 0.1"><site name="tip" pos="0.1 0.02 0.03" euler="5 6 7"/></frame></body></body></body></frame>
 </body></body></frame>
</worldbody></mujoco>"""

# Name of the robot, its text, its tip.
ROBOTS = {
    "ur5e": (UR5E, "attachment_site"),
    "panda": (PANDA, "hand"),
    "scara": (SCARA, "tool0"),
    "xarm6": (XARM, "link6"),
    "bench": (BENCH, "tip"),
}


def mujoco_poses(data: bytes, tip: str, names, q) -> np.ndarray:
    """Poses of a body or a site in the world as MuJoCo reads the whole file, (m, 4, 4)."""
    engine: Any = mujoco
    model = engine.MjModel.from_xml_string(data.decode())
    state = engine.MjData(model)
    bodies = [model.body(i).name for i in range(model.nbody)]
    frame = state.body(tip) if tip in bodies else state.site(tip)
    out = []
    for row in q:
        for name, value in zip(names, row, strict=True):
            state.joint(name).qpos[0] = value
        engine.mj_kinematics(model, state)
        out.append(se3.transform(frame.xmat.reshape(3, 3), frame.xpos))
    return np.array(out)
