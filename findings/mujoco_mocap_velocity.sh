#!/usr/bin/env bash
# Guess: a mocap="true" body that moves a little in each step also moves for the physics. Friction carries objects that lie on it, and a
#   damped spring between it and a node damps their relative motion.
# Seen: the body moves but has no velocity. A tray that slides 0.4 m in 2 s leaves its box in place, to 0.001 mm. A node that a spring
#   (k = 1000 N/m) and a dashpot (c = 20 N s/m) pull at 0.2 m/s stays behind by c v / k = 4 mm. A dashpot between two bodies with the same
#   motion must have no force.
# Source: mujoco-core 4.0.0; XML reference, body/mocap ("fixed from the viewpoint of the dynamics"), geom/surfacevel.
# Matters: recorded hands, grippers and clamps are replayed as mocap bodies. Pushing works, so the result appears right. Dragging, lifting
#   by friction and damped attachments do not work, and a fit to the recording attributes this to friction or stiffness.
# Works: a free body with gravcomp="1", welded to the mocap body. For objects on a tray, also set surfacevel of its geom in the file.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv && venv/bin/python -m pip install --quiet --disable-pip-version-check mujoco-core==4.0.0 numpy==2.4.6 || exit 2

cat >move.py <<'PYTHON'
import mujoco

SPEED, SECONDS, STEP, STIFFNESS = 0.2, 2.0, 0.001, 1000
TRAY = '<geom type="box" size="2 1 .05" mass="10"/>'
BOX = '<body name="box" pos="0 0 .15"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
HELD = f'<body name="hand" mocap="true">{TRAY}</body>{BOX}'
WELDED = f'<body name="hand" mocap="true"/><body name="plate" gravcomp="1"><freejoint/>{TRAY}</body>{BOX}'
WELD = '<equality><weld body1="hand" body2="plate" solref="0.01 1"/></equality>'
NODE = """<body name="node" pos="-0.1 0 0"><joint type="slide" axis="1 0 0"/>
  <geom size=".01" mass="1"/><site name="other"/></body>"""
DRAWN = f'<body name="hand" mocap="true"><site name="one"/></body>{NODE}'
CARRIER = '<body name="plate" gravcomp="1"><freejoint/><geom size=".01" mass="10"/><site name="one"/></body>'
DRAWN_WELDED = f'<body name="hand" mocap="true"/>{CARRIER}{NODE}'


def moved(world, more="", gravity=-9.81):
    """Places along x of all bodies after the hand moved at SPEED."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" gravity="0 0 {gravity}"/><worldbody>{world}</worldbody>{more}</mujoco>'
    )
    data = mujoco.MjData(model)
    for step in range(round(SECONDS / STEP)):
        data.mocap_pos[0, 0] = SPEED * STEP * step
        mujoco.mj_step(model, data)
    data.mocap_pos[0, 0] = SPEED * SECONDS
    mujoco.mj_kinematics(model, data)
    return {model.body(number).name: float(data.xpos[number, 0]) for number in range(model.nbody)}


print("mujoco-core", mujoco.__version__)
plain, welded, driven = moved(HELD), moved(WELDED, WELD), moved(HELD.replace("<geom ", f'<geom surfacevel="{SPEED} 0 0 0 0 0" ', 1))
print(f"tray as mocap body: tray {plain['hand']:.4f} m, box {plain['box']:.6f} m")
print(f"tray welded to it:  tray {welded['plate']:.4f} m, box {welded['box']:.6f} m")
print(f"with surfacevel:    tray {driven['hand']:.4f} m, box {driven['box']:.6f} m")
holds = abs(plain["hand"] - 0.4) < 1e-9 and abs(plain["box"]) < 1e-6 and welded["box"] > 0.35 and driven["box"] > 0.35
for damping in (10, 20):
    tendon = (
        f'<tendon><spatial stiffness="{STIFFNESS}" damping="{damping}" springlength="0.1"><site site="one"/><site site="other"/>'
        "</spatial></tendon>"
    )
    here, there = moved(DRAWN, tendon, gravity=0), moved(DRAWN_WELDED, tendon + WELD, gravity=0)
    lag, right, formula = here["hand"] - here["node"] - 0.1, there["plate"] - there["node"] - 0.1, damping * SPEED / STIFFNESS
    told = f"{1e3 * lag:.3f} mm (c v / k = {1e3 * formula:.3f}), welded by {1e3 * right:.3f} mm"
    print(f"c = {damping} N s/m: the node stays back by {told}")
    holds = holds and abs(lag - formula) < 5e-5 and abs(right) < 5e-5
raise SystemExit(not holds)
PYTHON
venv/bin/python move.py
