"""Which frame is shown: time runs, is scrubbed, and starts again at the end."""

from __future__ import annotations

from dataclasses import dataclass

SPEEDS = {"0.1 ×": 0.1, "0.25 ×": 0.25, "0.5 ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "4 ×": 4.0}


@dataclass
class Clock:
    """Time of a recording of `count` frames at `rate` frames/s, whose frames from `border` on are future frames."""

    count: int
    rate: float
    border: int
    time: float = 0.0
    """Frames since frame 0, with fractions."""
    speed: float = 1.0
    playing: bool = False
    loop: bool = True

    @property
    def frame(self) -> int:
        """The frame that is shown."""
        return min(int(self.time), self.count - 1)

    def advance(self, seconds: float) -> bool:
        """Let time pass; returns whether the frame has changed."""
        if not self.playing:
            return False
        before, self.time = self.frame, self.time + max(seconds, 0.0) * self.speed * self.rate
        if self.time >= self.count:
            self.time %= self.count
            if not self.loop:
                self.time, self.playing = float(self.count - 1), False
        return self.frame != before

    def show(self, frame: int) -> None:
        """Go to a frame; outside ones are the first or the last."""
        self.time = float(min(max(frame, 0), self.count - 1))

    @property
    def part(self) -> str:
        """The part of the recording that the frame belongs to."""
        return "training" if self.frame < self.border else "future"

    def text(self) -> str:
        """Frame, time and part in words."""
        return f"{self.part} frame {self.frame} of {self.count - 1}, {self.frame / self.rate:.2f} s"

    def bar(self) -> str:
        """The timeline as HTML: training and future, the border between them, and where we are."""
        border, here = (100 * value / max(self.count - 1, 1) for value in (self.border - 0.5, self.frame))
        border = min(max(border, 0.0), 100.0)
        colors = f"linear-gradient(to right, #9ecae1 {border:.2f}%, #fdae6b {border:.2f}%)"
        mark = "position:absolute;top:-3px;bottom:-3px;width:{w}px;background:{c};left:calc({x:.2f}% - {h}px)"
        color = "#2171b5" if self.part == "training" else "#d94801"
        return (
            "<div style='margin:.2em .8em .6em;font-size:.8em'>"
            f"<div style='position:relative;height:12px;border-radius:2px;background:{colors}'>"
            f"<div style='{mark.format(w=2, c='#333', x=border, h=1)}'></div>"
            f"<div style='{mark.format(w=4, c=color, x=here, h=2)}'></div></div>"
            f"<div style='margin-top:6px'><b style='color:{color}'>{self.text()}</b></div>"
            f"<div>blue: training, frames 0 to {self.border - 1}; orange: future, predicted</div></div>"
        )
