"""Render one small frame with MuJoCo and print the GL backend; fail when the frame is empty.

A script of its own, importing nothing of this package, so that a crash inside a GL driver ends only the
process that runs it: `lerobot-wm doctor` and scripts/setup.sh start it and look at its exit code.
"""

import os

import mujoco

SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="sphere" size="0.2" rgba="1 0.1 0.1 1"/>
    <camera name="front" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
</mujoco>
"""


def main() -> None:
    """Draw a red sphere on a black ground, 32x32 pixels, and look for both in the image.

    Raises:
        RuntimeError: if the GL backend gives an image without the sphere or without the ground.
    """
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height=32, width=32) as renderer:
        renderer.update_scene(data, camera="front")
        image = renderer.render()
    center, corner = image[16, 16], image[0, 0]
    if not (center[0] > 100 and corner.max() < 50):
        raise RuntimeError(f"rendered center {center} and corner {corner}, expected a red sphere on black")
    print(os.environ.get("MUJOCO_GL", "default"))


if __name__ == "__main__":
    main()
