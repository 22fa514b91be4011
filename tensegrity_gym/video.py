"""gymnasium's RecordVideo for envs whose steps have many frames."""

from __future__ import annotations

from typing import Any

from gymnasium import logger, wrappers


class RecordVideo(wrappers.RecordVideo):
    """Like ``gymnasium.wrappers.RecordVideo``, but takes all the frames of a step, of which that takes only the last.

    Make the env with ``render_mode="rgb_array_list"``. Needs moviepy, as gymnasium's does.
    """

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        if isinstance(frames, list):
            if not frames:
                logger.warn("RecordVideo: render() has just been called; its frames cannot be captured any more")
            self.render_history += frames
            self.recorded_frames += frames
        else:
            self.recorded_frames.append(frames)
