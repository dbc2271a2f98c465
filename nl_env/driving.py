"""``nl_env/Driving-v0``: adaptive depth sensing in synthetic traffic."""

from __future__ import annotations

from nl_env.config import DrivingConfig, EventCameraConfig, LidarConfig, SceneConfig
from nl_env.costs import TriggerCost
from nl_env.env import AdaptiveDepthEnv
from nl_env.streams import SyntheticStream
from nl_env.types import DepthExtrapolator


class DrivingEnv(AdaptiveDepthEnv):
    """
    ## Description
    A car with a roof-mounted LiDAR and an event camera drives through synthetic traffic. The LiDAR gives an
    exact depth frame every 100 ms; the event camera gives an event frame for every 20 ms slice. Whoever
    consumes the depth always uses the newest frame, so its error grows between LiDAR frames. At every
    slice the agent decides whether to *trigger*: to have the depth of this moment extrapolated from the
    last LiDAR frame and the events since. Triggering everywhere means 50 depth frames per second,
    triggering nowhere 10; the task is to trigger when it pays (the NeuroLiDAR paper's adaptive frame rate).

    ## Action Space
    `Discrete(2)`: 0 holds the last depth frame, 1 triggers an extrapolation. At a slice with a LiDAR frame
    the action has no effect and costs nothing. Anything but the integers 0 and 1 raises `ValueError`.

    ## Observation Space
    The events of the last 20 ms, summed with their polarity per pixel (Eq. 1 of the paper).

    | `obs_mode` | space |
    |---|---|
    | `"image"` (default) | `Box(0, 255, (1, H, W), uint8)`, offset by 128 and clipped |
    | `"signed"` | `Box(-128, 127, (1, H, W), int8)`, clipped |
    | `"dict"` | `{"event_frame": image, "state": Box(0, 1, (4,), float32)}` |
    | `"statistics"` | `Box(0, 1, (100,), float32)`: the state and the event activity of 12 regions |

    `state` holds the time since the last LiDAR frame and since the last depth frame (as shares of the LiDAR
    period; 0 where a LiDAR frame arrives at this slice), the event rate as `x / (1 + x)` with x events per
    pixel and slice, and the last action. The activity of a region is its share of pixels with events and
    its mean absolute event sum, each over this slice, since the held depth frame was made, since the last
    LiDAR frame, and over the LiDAR interval before (`nl_env.statistics`), compressed as `x / (x + 0.2)`.

    With a range of trigger costs, `"dict"` gains `"trigger_cost"` `Box(0, 1, (1,), float32)` and
    `"statistics"` one more last entry: 0 at 1e-4 to 1 at 1e2, logarithmic. The other modes refuse a range.

    ## Rewards
    `-(error / error_scale) - trigger_cost * triggered`, where the error compares the held depth with the
    true depth at the end of the slice. `log_mae`, the mean over all pixels of `|ln d - ln d_true|`, is the
    default. Each part is in `info` as `reward/error` and `reward/trigger`. With `trigger_cost=(low, high)`
    every episode draws its own cost, uniformly in the logarithm, and observations show it.

    ## Starting State
    `reset(seed=s)` runs sequence s: its seed determines scenario, style, weather, traffic and noise.
    `reset()` draws the next training sequence from the environment's own generator;
    `reset(options={"sequence": s})` runs sequence s and leaves that generator alone.
    `reset(options={"trigger_cost": c})` sets the cost of the episode. Seeds are split into training,
    validation and test (`nl_env.config.SPLITS`). The LiDAR frame of t = 0 is held already; the first
    observation shows the events of the first 20 ms.

    ## Episode End
    Truncated at the end of the sequence, never terminated. The last observation repeats the last slice.

    ## Information
    The same keys and types come from `reset` (values of t = 0) and every `step` (values of the slice acted
    on): `t` (us), `lidar`, `triggered`, `depth_age` (us), `log_mae`, `imae` (1/km), `bad_25`, `rmse` (m),
    `abs_rel`, `held_depth_source` (`"lidar"` or `"extrapolated"`), `ego_speed` (m/s), `shortest_distance`
    (m), `new_actors`, `keyframe` and its causes `keyframe_speed`, `keyframe_distance`, `keyframe_new`,
    `event_count`, `active_fraction`, `effective_rate` (Hz, since the start) and the reward's parts. `rmse`
    and `abs_rel` are NaN for an image without a single true return. Depth frames are reached through
    `env.unwrapped.depth`, `.true_depth` and `.prior_depth`.

    ## Arguments
    * `resolution`: `"full"` 480x640, `"half"` 240x320, `"quarter"` 120x160 (default).
    * `scenario`, `style`, `weather`: a name from `nl_env.config`, or None (default) to draw from the mix.
    * `duration`: length of a sequence, s (20).
    * `lidar_hz`: LiDAR frames per second: 1, 2, 5, 10 (default) or 25.
    * `beams`: scan lines of the LiDAR: 16, 32, 64, 128, or 0 (default) for a dense one.
    * `noise`: event camera, `"realistic"` (default) or `"ideal"`.
    * `extrapolator`: `"unet"` (default: motion, warp and a network, with shipped weights), `"unet-paper"`,
      `"warp"`, `"repeat"`, `"linear"`, `"exponential"`, a path to weights, or any
      `nl_env.types.DepthExtrapolator`.
    * `odometry`: let a named extrapolator use the true camera poses (False).
    * `runtime`: what runs a network: `"auto"` (CUDA where there is one, else PyTorch), `"torch"`,
      `"openvino"`, `"onnxruntime"` or `"cuda"`.
    * `obs_mode`, `error`, `error_scale`: see above.
    * `trigger_cost`: a number (0.1), or a pair within 1e-4 to 1e2 of which each episode draws its own.
    * `render_mode`: `"rgb_array"`, `"depth_array"`, `"human"` or None.

    ## Version History
    * v0: first version.
    """

    def __init__(
        self,
        *,
        resolution: str = "quarter",
        scenario: str | None = None,
        style: str | None = None,
        weather: str | None = None,
        duration: float = 20.0,
        lidar_hz: int = 10,
        beams: int = 0,
        noise: str = "realistic",
        extrapolator: str | DepthExtrapolator = "unet",
        odometry: bool = False,
        runtime: str = "auto",
        obs_mode: str = "image",
        error: str = "log_mae",
        error_scale: float = 0.05,
        trigger_cost: TriggerCost = 0.1,
        render_mode: str | None = None,
    ) -> None:
        config = DrivingConfig(
            resolution=resolution,
            scene=SceneConfig(scenario=scenario, style=style, weather=weather, duration_s=duration),
            events=EventCameraConfig.preset(noise),
            lidar=LidarConfig(rate_hz=lidar_hz, beams=beams),
        )
        super().__init__(
            SyntheticStream(config),
            extrapolator=extrapolator,
            odometry=odometry,
            runtime=runtime,
            obs_mode=obs_mode,
            error=error,
            error_scale=error_scale,
            trigger_cost=trigger_cost,
            render_mode=render_mode,
        )
