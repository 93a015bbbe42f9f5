"""Walk a robot by a policy in an ONNX file, with onnxruntime and MuJoCo alone: what deployment code has to do.

    python -m diffsim export diffsim/policies/go2.pt go2.onnx
    python examples/run_onnx.py go2.onnx --command 0.5 0 0
    MUJOCO_GL=egl python examples/run_onnx.py go2.onnx --video go2.mp4 --model mujoco_menagerie/unitree_go2/scene.xml

The file's metadata tell all about the policy (docs/viewing.md). A servo gets the target, a motor the torque of a servo.
"""

import argparse
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import glfw
import mujoco
import mujoco.viewer
import numpy as np
from onnxruntime import InferenceSession


def walk(policy: InferenceSession, model: mujoco.MjModel, command: Sequence[float], seconds: float) -> Iterator:
    """MuJoCo's data of the robot after each control step."""
    told, data, turn = policy.get_modelmeta().custom_metadata_map, mujoco.MjData(model), np.empty(9)
    lists = "default_joint_pos", "action_scale", "joint_stiffness", "joint_damping"
    home, scale, stiffness, damping = (np.array(told[name].split(","), dtype=float) for name in lists)
    joints = [model.joint(name).id for name in told["joint_names"].split(",")]
    motors = [model.actuator_trnid[:, 0].tolist().index(joint) for joint in joints]
    servo = model.actuator_biastype[motors] == mujoco.mjtBias.mjBIAS_AFFINE
    q, v = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    data.qpos[:7], data.qpos[q] = (0, 0, float(told["root_height"]), 1, 0, 0, 0), home
    action, clock, dt = 0 * home, 0.0, float(told["control_dt"])
    for _ in range(round(seconds / dt)):
        mujoco.mju_quat2Mat(turn, data.qpos[3:7])
        to_body, angle = turn.reshape(3, 3).T, 2 * np.pi * clock
        parts = {"base_lin_vel": to_body @ data.qvel[:3], "base_ang_vel": data.qvel[3:6], "command": command}
        parts |= {"projected_gravity": -to_body[:, 2], "clock_sin": [np.sin(angle)], "clock_cos": [np.cos(angle)]}
        parts |= {"actions": action, "joint_pos": data.qpos[q] - home, "joint_vel_x0.1": 0.1 * data.qvel[v]}
        seen = np.concatenate([parts[name] for name in told["observation_names"].split(",")])
        action = policy.run(["action"], {"observation": seen[None].astype(np.float32)})[0][0]
        clock = (clock + dt * float(told["gait_frequency"])) % 1
        target = home + scale * action
        for _ in range(round(dt / model.opt.timestep)):
            torque = stiffness * (target - data.qpos[q]) - damping * data.qvel[v]
            data.ctrl[motors] = np.where(servo, target, torque)
            mujoco.mj_step(model, data)
        yield data


def check_opengl(model: mujoco.MjModel, video: bool) -> None:
    """Raise RuntimeError where a window or a video cannot be drawn; MuJoCo's window would end the process."""
    if video:
        try:
            mujoco.Renderer(model, 8, 8).close()
        except Exception as error:  # a class for each way to have no OpenGL
            raise RuntimeError(f"no OpenGL: set MUJOCO_GL=egl or MUJOCO_GL=osmesa ({error})") from error
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of GLFW
        if not glfw.init():
            raise RuntimeError("a window needs a display: without one, give --video go2.mp4 and set MUJOCO_GL=egl")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="an ONNX file of go1, go2 or g1")
    parser.add_argument("--model", help="MJCF of the robot on a ground; by default that of this repository")
    parser.add_argument("--command", nargs=3, type=float, default=[0.5, 0, 0], help="vx, vy [m/s] and yaw rate [rad/s]")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--video", help="an .mp4 instead of the window, which needs a display; needs imageio-ffmpeg")
    args = parser.parse_args()
    if not Path(args.policy).is_file():
        parser.error(f"no such file: {args.policy}; write one by python -m diffsim export CHECKPOINT {args.policy}")
    try:
        policy = InferenceSession(args.policy)
    except Exception as error:  # onnxruntime has a class for each status
        parser.error(f"{args.policy} cannot be read: {error}")
    told = policy.get_modelmeta().custom_metadata_map
    if "command_range" not in told:
        parser.error(
            f"{args.policy}: a policy of {told.get('task')}, which follows no commands as those of go1, go2 and g1; "
            "examples/own_quadruped.py shows how to play another one in MuJoCo"
        )
    if any(abs(x) > float(most) for x, most in zip(args.command, told["command_range"].split(","), strict=True)):
        parser.error(f"--command: of a {told['task']} at most {told['command_range']} to either side")
    model = mujoco.MjModel.from_xml_path(args.model or f"{Path(__file__).parents[1]}/diffsim/assets/{told['task']}.xml")
    try:
        check_opengl(model, bool(args.video))
    except RuntimeError as error:
        parser.error(str(error))
    states, camera = walk(policy, model, args.command, args.seconds), mujoco.MjvCamera()
    camera.type, camera.trackbodyid, camera.distance = mujoco.mjtCamera.mjCAMERA_TRACKING, 1, 2.0
    if args.video:
        from imageio_ffmpeg import write_frames

        with mujoco.Renderer(model, 480, 640) as renderer:
            (video := write_frames(args.video, (640, 480), fps=1 / float(told["control_dt"]))).send(None)
            for data in states:
                renderer.update_scene(data, camera)
                video.send(renderer.render())
            video.close()
        print(args.video)
    else:
        with mujoco.viewer.launch_passive(model, next(states)) as viewer:
            while viewer.is_running() and next(states, None):
                viewer.sync()
                time.sleep(float(told["control_dt"]))
