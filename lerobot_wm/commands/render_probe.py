"""Render a small frame with MuJoCo and print the GL backend; fail if the frame is empty.

`lerobot-wm doctor` and scripts/setup.sh run this script in a process of its own, which a crash inside a GL driver may
end. It imports nothing of this package.
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
    """Render a red sphere on a black background, 32x32 pixels, and check both.

    Raises:
        RuntimeError: The image lacks the sphere or the background.
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
