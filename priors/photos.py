"""Photos of panoramas and rooms by random cameras, with the truth of what they clip; in torch, on any device."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .panoramas import Pack
from .photo_values import Photos, averaged, dct, interpolate, inverse, log_range, lower_median
from .rooms import LitRooms

SIZES = (64, 80, 96, 128)  # Height and width of a batch's photos
SCALES, LARGEST = (1.0, 1.25, 2.0), 160  # Of a training: photos are averaged from these multiples, up to this size
MOST_CLIPPED, LEAST_CLIPPED = 0.35, 5e-4  # Shares of the pixels of a photo that is not overexposed
DARKEST = 9.0  # Most stops by which white is above the median of a photo of a panorama
OVEREXPOSED = (0.1, 0.95)  # Shares of the pixels of an overexposed photo that clip
ROOM_SHARE = 0.35  # Of the photos of a training
CONTRAST = 0.35  # By how much the power may differ from 1 to which a panorama's light over its median is raised
MOST_STRETCH = 2.2
"""Largest power to which small lights are raised. Panoramas of 512 columns average small lamps with what surrounds
them; photos resolve them."""
LIGHT_WINDOW, MOST_LIGHT = 4, 0.004
"""A light is small where at most a share MOST_LIGHT of the photo is above white within a square of 1 / LIGHT_WINDOW of
its width around it. At twice the share nothing is raised: a window or a sky is as bright in a panorama as it is. A
pixel of such a panorama is 0.7 degrees wide, and 3 x 3 of them cover up to 0.36 % of a photo."""
OVEREXPOSED_LIGHT_SHARE = 0.4
"""Share of the overexposed photos that lights are put into: those of panoramas alone show too few lamps within what
they light."""
MOST_LIGHTS = 3  # Largest number of lights put in
LAMP_RADII, LAMP_STOPS = (0.003, 0.06), (2.0, 12.5)
"""Radii of round lamps over the photo's width, and stops of their light over the photo's median."""
PANEL_SIZES, PANEL_STOPS = (0.04, 0.5), (1.0, 8.0)
"""Half sides of windows and screens over the photo's width, and stops of their mean light over the photo's median."""
COLORED_SHARE, COLOR_STOPS = 0.4, (3.0, 10.0)
"""Share of the photos whose lamps are colored, as LEDs and neon tubes are, and the range of the stops by which channels
of one may differ. Of such lamps photos often clip one or two channels alone."""
TINT_SHARE = 0.3  # Of the photos whose small lights are raised: those in which they are colored, too
SOFT_SHARE, SHADE_STOPS = 0.3, 3.0  # Share of the photos whose lamps are darker at their rims, and by how many stops
CELL_STOPS = 1.5  # Most stops by which the cells of a colored screen differ from their mean
HEIGHTS = (1.5, 40.0)  # Distances of lights from the surface behind them, over their radii
PAGE_LIGHT = (0.7, 2.0)  # Of a white surface that is no lamp, over white
DIM_SHARE, DIM_STOPS = 0.5, 4.0  # Share of these whose scene is darker, and by how many stops at most: it may not clip
WAVE_SHARE, WAVES, MOST_WAVE = 0.5, (2.0, 25.0), 0.4
"""Share of these surfaces whose light varies smoothly, as on snow, radians of it over the photo's width, and the most
change of its logarithm. Where it goes over into what clips without an edge, little is above white."""
TEXT_SHARE, PICTURE_SHARE = 0.6, 0.25  # Shares of these surfaces that are printed with text and with a dark picture
LINE_PITCH = (0.02, 0.14)  # Distances of lines of text over the photo's width
PLAIN_SHARES = (0.002, 0.01, 0.02, 0.05, 0.1, 0.2)  # Of the pixels of a plain photo that clip
LEVELS = 255


class Camera:
    """Random photos of a pack's panoramas and rooms."""

    def __init__(
        self,
        pack: Pack,
        device: torch.device | str,
        chosen: np.ndarray,
        *,
        rooms: bool,
        seed: int,
        stretch_share: float = 0.0,
        light_share: float = 0.0,
        overexposed_light_share: float = OVEREXPOSED_LIGHT_SHARE,
        overexposed_share: float = 0.0,
        page_share: float = 0.0,
        varied: bool = False,
        lit_rooms: LitRooms | None = None,
        darkest: float = DARKEST,
        scales: tuple[float, ...] = (1.0,),
    ):
        """Copy panoramas, rooms and curves to the device.

        Args:
            pack: of `read_pack`.
            device: of the photos.
            chosen: indices of the panoramas that are photographed.
            rooms: whether rooms are photographed too.
            seed: of every random number.
            stretch_share: of the photos, those whose small lights are raised, unless they are plain.
            light_share: share of the usual photos that lights are put into, unless they are plain.
            overexposed_light_share: the same share of the overexposed photos.
            overexposed_share: share of the photos of which up to 95 % clip, unless they are plain.
            page_share: share of the photos with a white surface that is no lamp, unless they are plain.
            varied: whether panoramas have random contrasts and orders of channels, so that few of them teach more.
            lit_rooms: rooms that are photographed in place of panoramas and of the pack's rooms.
            scales: sizes at which photos are taken over those to which they are averaged; one for all photos of a call.
            darkest: most stops by which white may be above the median of a photo that is not overexposed.
        """
        self.varied, self.lit_rooms, self.darkest, self.scales = varied, lit_rooms, darkest, scales
        self.stretch_share, self.overexposed_share, self.page_share = stretch_share, overexposed_share, page_share
        self.light_share, self.overexposed_light_share = light_share, overexposed_light_share
        self.device, self.random = torch.device(device), np.random.default_rng(seed)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        panoramas = torch.from_numpy(pack.panoramas[chosen]).permute(0, 3, 1, 2)
        # One more column, so that interpolation goes on behind the last.
        self.panoramas = torch.cat([panoramas, panoramas[..., :1]], 3).to(self.device)
        self.rooms = torch.from_numpy(pack.rooms).permute(0, 1, 4, 2, 3).to(self.device) if rooms else None
        self.curves = torch.from_numpy(pack.curves).to(self.device)
        self.dct = dct(8).to(self.device)

    def take(self, count: int, size: int | None = None, *, plain: bool = False) -> Photos:
        """Return `count` photos of one size; plain: by sRGB, without noise, JPEG, white balance and errors."""
        size = size or int(self.random.choice(SIZES))
        if not plain and len(self.scales) > 1:
            fine = max(size, min(8 * round(size * self.random.choice(self.scales) / 8), LARGEST))
            return averaged(self._take(count, fine, plain), size)
        return self._take(count, size, plain)

    def _take(self, count: int, size: int, plain: bool) -> Photos:
        if self.lit_rooms is not None:
            return self._expose(self.lit_rooms.take(count, size), plain)
        rooms = 0 if self.rooms is None else int(self.random.binomial(count, ROOM_SHARE))
        views = [self._panorama_views(count - rooms, size)]
        if rooms:
            views.append(self._room_views(rooms, size))
        return self._expose(torch.cat(views), plain)

    def _uniform(self, count: int, low: float, high: float, channels: int = 1) -> Tensor:
        values = torch.rand(count, channels, 1, 1, generator=self.generator, device=self.device)
        return low + (high - low) * values

    def _panorama_views(self, count: int, size: int) -> Tensor:
        random, fine = self.random, 2 * size
        index = torch.from_numpy(random.integers(len(self.panoramas), size=count)).to(self.device)
        yaw, pitch, roll, fov = (
            torch.from_numpy(np.radians(random.uniform(low, high, count)).astype(np.float32)).to(self.device)
            for low, high in ((0, 360), (-35, 40), (-8, 8), (35, 90))
        )
        steps = (torch.arange(fine, device=self.device) + 0.5 - fine / 2) / (fine / 2)
        half = torch.tan(fov / 2)[:, None, None]
        x, y = steps[None, None, :] * half, -steps[None, :, None] * half
        x, y = x.expand(count, fine, fine), y.expand(count, fine, fine)
        cos, sin = torch.cos(roll)[:, None, None], torch.sin(roll)[:, None, None]
        x, y = cos * x - sin * y, sin * x + cos * y
        cos, sin = torch.cos(pitch)[:, None, None], torch.sin(pitch)[:, None, None]
        up, forward = y * cos + sin, cos - y * sin
        longitude = torch.atan2(x, forward) + yaw[:, None, None]
        latitude = torch.atan2(up, torch.hypot(x, forward))
        width = self.panoramas.shape[3] - 1
        across = 2 * (torch.remainder(longitude / (2 * math.pi), 1) * width) / width - 1
        grid = torch.stack([across, -2 * latitude / math.pi], -1)
        views = F.grid_sample(self.panoramas[index], grid, mode="bilinear", padding_mode="border", align_corners=True)
        views = F.avg_pool2d(views, 2)
        mirrored = torch.from_numpy(random.random(count) < 0.5).to(self.device)
        views = torch.where(mirrored[:, None, None, None], views.flip(3), views)
        return self._vary(views) if self.varied and count else views

    def _vary(self, views: Tensor) -> Tensor:
        """Return views [B, 3, S, S] of other contrasts about their medians, and half of them of other colors."""
        count = len(views)
        brightest = views.amax(1, keepdim=True).clamp_min(1e-9)
        median = lower_median(brightest.flatten(1))[..., None, None]
        views = views * (brightest / median) ** self._uniform(count, -CONTRAST, CONTRAST)
        orders = np.stack([self.random.permutation(3) if self.random.random() < 0.5 else np.arange(3) for _ in views])
        return views.gather(1, torch.from_numpy(orders).to(self.device)[:, :, None, None].expand_as(views))

    def _room_views(self, count: int, size: int) -> Tensor:
        assert self.rooms is not None
        index = torch.from_numpy(self.random.integers(len(self.rooms), size=count)).to(self.device)
        lights = self.rooms.shape[1]
        weights = 2.0 ** self._uniform(count, -7, 3, lights)
        views = (self.rooms[index] * weights[..., None]).sum(1)
        part = float(self.random.uniform(0.6, 1))
        whole = views.shape[-1]
        side = int(part * whole)
        top, left = self.random.integers(0, whole - side + 1, 2)
        views = F.interpolate(views[..., top : top + side, left : left + side], size=(size, size), mode="area")
        mirrored = torch.from_numpy(self.random.random(count) < 0.5).to(self.device)
        return torch.where(mirrored[:, None, None, None], views.flip(3), views)

    def _expose(self, radiance: Tensor, plain: bool) -> Photos:
        """Photograph radiance [B, 3, S, S] at random exposures."""
        count = len(radiance)
        over = self._uniform(count, 0, 1)[:, 0, 0, 0] < self.overexposed_share
        if not plain and (self.light_share or self.overexposed_share):
            radiance = self._with_lights(radiance, over)
        if not plain:
            radiance = radiance * 2 ** self._uniform(count, -0.5, 0.5, 3)  # White balance
        brightest = radiance.amax(1).flatten(1)
        # Half of the photos choose white by the share that clips, half by a distance from the middle grey.
        share = 2.0 ** self._uniform(count, math.log2(LEAST_CLIPPED), math.log2(MOST_CLIPPED))[:, 0, 0, 0]
        if plain:
            share = torch.from_numpy(self.random.choice(PLAIN_SHARES, count)).to(share)
        else:
            share = torch.where(over, self._uniform(count, *OVEREXPOSED)[:, 0, 0, 0], share)
        ranks = ((1 - share) * (brightest.shape[1] - 1)).long()
        by_share = brightest.sort(1).values.gather(1, ranks[:, None])
        by_middle = lower_median(brightest) * 2 ** self._uniform(count, 0.5, self.darkest)[:, 0, 0]
        most = brightest.sort(1).values[:, int((1 - LEAST_CLIPPED) * (brightest.shape[1] - 1)), None]
        first = (torch.rand(count, 1, generator=self.generator, device=self.device) < 0.5) | plain
        if not plain:
            first = first | over[:, None]
        white = torch.where(first, by_share, torch.minimum(by_middle, most)).clamp_min(1e-12)
        exposure = radiance / white[:, :, None, None]
        if not plain:
            exposure = self._stretch(exposure)
        if not plain and self.page_share:
            exposure = self._with_pages(exposure)
        truth = exposure.clamp_min(1).log2()
        noisy = exposure
        if not plain:
            noise = torch.randn(exposure.shape, generator=self.generator, device=self.device)
            strength = 2.0 ** self._uniform(count, -14, -7)
            noisy = (noisy + noise * (strength * (noisy.clamp(0, 1) + 0.01)).sqrt()).clamp_min(0)
        chosen = np.zeros(count, int) if plain else self.random.integers(len(self.curves), size=count)
        curves = self.curves[torch.from_numpy(chosen).to(self.device)]
        encoded = interpolate(curves, noisy.clamp(0, 1))
        if not plain:
            encoded = self._jpeg(encoded)
        codes = torch.round(encoded * LEVELS)
        clipped = (codes >= LEVELS).float()
        decoded = inverse(curves, codes / LEVELS)
        if not plain:
            decoded = decoded ** (2 ** self._uniform(count, -0.2, 0.2))
        return Photos(decoded, clipped, truth * clipped)

    def _stretch(self, exposure: Tensor) -> Tensor:
        """Return exposures [B, 3, S, S], some with brighter small lights, of the same hue."""
        count = len(exposure)
        power = self._uniform(count, 1, MOST_STRETCH)
        power = torch.where(self._uniform(count, 0, 1) < self.stretch_share, power, 1.0)
        brightest = exposure.amax(1, keepdim=True)
        small = _smallness(brightest > 1)
        raised = exposure * brightest.clamp_min(1) ** ((power - 1) * small)
        tint = self._color(count)
        is_tinted = (self._uniform(count, 0, 1) < TINT_SHARE * self.stretch_share) & (brightest > 1)
        return raised * (tint / tint.amax(1, keepdim=True)) ** (small * is_tinted)

    def _color(self, count: int) -> Tensor:
        """Return [B, 3, 1, 1] colors of mean 1, whose channels differ by up to COLOR_STOPS."""
        strength = math.log(2) / 2 * self._uniform(count, *COLOR_STOPS)
        return 3 * torch.softmax(strength * self._uniform(count, -1, 1, 3), 1)

    def _with_lights(self, radiance: Tensor, over: Tensor) -> Tensor:
        """Return radiance [B, 3, S, S], some with round lamps, windows and screens that light what is around them.

        Photos that will be overexposed, where `over` [B] is set, have them by a share of their own.

        A surface at a distance h behind a light of radiance L and radius r receives L pi r^2 h / (d^2 + h^2)^1.5 at a
        distance d from its foot. The surface reflects it as it reflects the photo's mean radiance.
        """
        count, size = len(radiance), radiance.shape[-1]
        steps = (torch.arange(size, device=self.device) + 0.5) / size
        light_share = torch.where(over, self.overexposed_light_share, self.light_share)[:, None, None, None]
        has_lights = self._uniform(count, 0, 1) < light_share
        median = lower_median(radiance.amax(1).flatten(1)).clamp_min(1e-6)[..., None, None]
        ambient = radiance.mean((1, 2, 3), keepdim=True).clamp_min(1e-6)
        panel = self._uniform(count, 0, 1) < 0.5
        is_colored = ~panel & (self._uniform(count, 0, 1) < COLORED_SHARE)
        is_soft = ~panel & (self._uniform(count, 0, 1) < SOFT_SHARE)
        lamp_light = median * 2 ** self._uniform(count, *LAMP_STOPS)
        panel_light = median * 2 ** self._uniform(count, *PANEL_STOPS)
        lamp_radius = log_range(self._uniform(count, 0, 1), *LAMP_RADII)
        half_width, half_height = (log_range(self._uniform(count, 0, 1), *PANEL_SIZES) for _ in range(2))
        half_width = torch.where(panel, half_width, lamp_radius * 2 ** self._uniform(count, -0.3, 3).clamp_min(0))
        half_height = torch.where(panel, half_height, lamp_radius)
        content = torch.where(panel, self._panel_content(radiance, steps), 1.0)
        light = torch.where(panel, panel_light, lamp_light)
        area = half_width * half_height
        height = area.sqrt() * log_range(self._uniform(count, 0, 1), *HEIGHTS)
        number = 1 + (self._uniform(count, 0, 1) ** 2 * MOST_LIGHTS)
        glow, lights, covered = 0.0, torch.zeros_like(radiance), torch.zeros_like(radiance[:, :1])
        for k in range(MOST_LIGHTS):
            used = has_lights & (number > k) & ~(panel & (k > 0))
            across = steps[None, None, None, :] - self._uniform(count, -0.1, 1.1)
            down = steps[None, None, :, None] - self._uniform(count, -0.1, 1.1)
            turn = self._uniform(count, -0.15, 0.15)
            u, v = turn.cos() * across + turn.sin() * down, turn.cos() * down - turn.sin() * across
            tint = torch.where(is_colored, self._color(count), 2 ** (0.6 * self._uniform(count, -1, 1, 3)))
            shade = torch.where(is_soft, 2 ** (-SHADE_STOPS * ((u / half_width) ** 2 + (v / half_height) ** 2)), 1.0)
            box = torch.maximum(u.abs() - half_width, v.abs() - half_height)
            disc = (torch.hypot(u / half_width, v / half_height) - 1) * half_height
            inside = ((0.5 - size * torch.where(panel, box, disc)).clamp(0, 1) * used).to(radiance)
            lights = lights * (1 - inside) + inside * light * content * tint * shade
            covered = covered * (1 - inside) + inside
            glow = glow + light * tint * area * height / (u**2 + v**2 + height**2) ** 1.5 * used
        return radiance * (1 + glow / ambient) * (1 - covered) + lights

    def _panel_content(self, radiance: Tensor, steps: Tensor) -> Tensor:
        """Return [B, 3, S, S] of mean about 1: other views, colored cells, or plain light, some behind bars."""
        count, size = len(radiance), len(steps)
        other = radiance.roll(1, 0)
        other = other / other.mean((1, 2, 3), keepdim=True).clamp_min(1e-9)
        places = self._uniform(count, 0, 1, 48)[:, :, 0]
        colors = torch.softmax(3.5 * self._uniform(count, -1, 1, 72).reshape(count, 24, 3), 2) * 3
        colors = colors * 2 ** (CELL_STOPS * self._uniform(count, -1, 1, 24)[..., 0])
        across, down = (
            (steps.repeat(size)[None, None] - places[:, :24]),
            (steps.repeat_interleave(size)[None, None] - places[:, 24:]),
        )
        nearest = (across**2 + down**2).argmin(1)
        cells = colors.gather(1, nearest[..., None].expand(-1, -1, 3)).permute(0, 2, 1).reshape(count, 3, size, size)
        kind = self._uniform(count, 0, 1)
        content = torch.where(kind < 0.4, other, torch.where(kind < 0.75, cells, torch.ones_like(other)))
        period, phase = log_range(self._uniform(count, 0, 1), 0.06, 0.4), self._uniform(count, 0, 1)
        bars = torch.maximum(*((steps.reshape(shape) / period + phase) % 1 for shape in ((1, 1, 1, -1), (1, 1, -1, 1))))
        has_bars = self._uniform(count, 0, 1) < 0.4
        return torch.where(has_bars & (bars > 0.9), 0.02 * content, content)

    def _with_pages(self, exposure: Tensor) -> Tensor:
        """Return exposures [B, 3, S, S], some with a sheet, a wall or snow that is lit to about white, not a lamp."""
        count, size = len(exposure), exposure.shape[-1]
        place = (torch.arange(size, device=self.device) + 0.5) / size
        across = place[None, :] - self._uniform(count, 0, 1)[:, 0]
        down = place[:, None] - self._uniform(count, 0, 1)[:, 0]
        turn = self._uniform(count, 0, math.pi)[:, 0]
        u, v = turn.cos() * across + turn.sin() * down, turn.cos() * down - turn.sin() * across
        half_width, half_height = (2.0 ** self._uniform(count, -4.5, 1)[:, 0] for _ in range(2))
        used = self._uniform(count, 0, 1)[:, 0] < self.page_share
        inside = ((u.abs() < half_width) & (v.abs() < half_height) & used)[:, None]
        slope = self._uniform(count, -0.4, 0.4)[:, 0]
        light = log_range(self._uniform(count, 0, 1), *PAGE_LIGHT)
        light = light * torch.exp(slope * u / half_width.clamp_min(0.1) + self._waves(u, v))[:, None]
        grain = torch.randn(exposure.shape, generator=self.generator, device=self.device)
        light = light * torch.exp(self._uniform(count, 0, 0.06) * grain)
        reflected = self._print_of(u, v, half_width, half_height)[:, None]
        dim = torch.where(self._uniform(count, 0, 1) < DIM_SHARE, 2 ** self._uniform(count, -DIM_STOPS, 0), 1.0)
        return torch.where(inside, light * reflected, torch.where(used[:, None], dim * exposure, exposure))

    def _waves(self, u: Tensor, v: Tensor) -> Tensor:
        """Return [B, S, S] the logarithm of a factor of the light at places u, v [B, S, S]; 0 in most photos."""
        count, wave = len(u), torch.zeros_like(u)
        for _ in range(3):
            angle, phase = (self._uniform(count, 0, 2 * math.pi)[:, 0] for _ in range(2))
            rate = log_range(self._uniform(count, 0, 1)[:, 0], *WAVES)
            wave = wave + torch.sin(rate * (angle.cos() * u + angle.sin() * v) + phase) / 2
        return wave * self._uniform(count, 0, MOST_WAVE)[:, 0] * (self._uniform(count, 0, 1)[:, 0] < WAVE_SHARE)

    def _print_of(self, u: Tensor, v: Tensor, half_width: Tensor, half_height: Tensor) -> Tensor:
        """Return what a printed surface reflects over what blank paper does, [B, S, S] in [0, 1].

        Lines of words of letters of random widths, or a dark picture, within a margin; many surfaces are blank.

        Args:
            u: [B, S, S] places along the lines, from the surface's middle, over the photo's width.
            v: the same across the lines.
            half_width: [B, 1, 1] of the surface, along the lines.
            half_height: the same across the lines.
        """
        count = len(u)

        def uniform(low: float, high: float) -> Tensor:
            return self._uniform(count, low, high)[:, 0]

        def noise(column: Tensor, row: Tensor) -> Tensor:
            return torch.frac((torch.sin(12.9898 * column + 78.233 * row + seed) * 4375.85).abs())

        seed, margin = uniform(0, 100), uniform(0.75, 1)
        printed = (u.abs() < margin * half_width) & (v.abs() < margin * half_height)
        pitch = log_range(uniform(0, 1), *LINE_PITCH)
        row, column = torch.floor(v / pitch), u / (pitch * uniform(0.15, 0.6))
        in_line = torch.remainder(v / pitch, 1) < uniform(0.35, 0.7)
        letters = (noise(column.floor(), row) < uniform(0.4, 0.8)) & (noise((column / 6).floor(), row + 0.5) < 0.8)
        text = in_line & letters & (uniform(0, 1) < TEXT_SHARE)
        corner = [uniform(-1, 1) * margin * half for half in (half_width, half_height)]
        sizes = [uniform(0.1, 0.7) * half for half in (half_width, half_height)]
        picture = ((u - corner[0]).abs() < sizes[0]) & ((v - corner[1]).abs() < sizes[1])
        picture = picture & (uniform(0, 1) < PICTURE_SHARE)
        ink = log_range(uniform(0, 1), 0.03, 0.6)
        return torch.where(printed & (text | picture), ink, 1.0)

    def _jpeg(self, encoded: Tensor) -> Tensor:
        """Return a part of the photos as a JPEG of random quality leaves them, without subsampling of color."""
        count, _, height, width = encoded.shape
        luma = encoded.new_tensor([[0.299, 0.587, 0.114], [-0.169, -0.331, 0.5], [0.5, -0.419, -0.081]])
        planes = torch.einsum("kc,bchw->bkhw", luma, encoded)
        blocks = planes.reshape(count, 3, height // 8, 8, width // 8, 8)
        frequencies = torch.einsum("ui,bcyixj,vj->bcyuxv", self.dct, blocks, self.dct)
        order = torch.arange(8, device=self.device)
        coarse = 1 + (order[:, None] + order[None, :]).float()
        step = coarse[None, None, None, :, None, :] * 2 ** self._uniform(count, -10, -6.5)[..., None, None]
        # The strongest quantization of each is that of about quality 70, the weakest that of 98.
        frequencies = torch.round(frequencies / step) * step
        blocks = torch.einsum("ui,bcyuxv,vj->bcyixj", self.dct, frequencies, self.dct)
        decoded = torch.einsum("kc,bchw->bkhw", torch.linalg.inv(luma), blocks.reshape(count, 3, height, width))
        used = torch.rand(count, 1, 1, 1, generator=self.generator, device=self.device) < 0.6
        return torch.where(used, decoded.clamp(0, 1), encoded)


def _smallness(above: Tensor) -> Tensor:
    """Return [B, 1, S, S] in [0, 1] for pixels above white: 1 in a small light, 0 in a large area."""
    wide = above.shape[-1] // LIGHT_WINDOW // 2 * 2 + 1
    around = F.avg_pool2d(above.float(), wide, stride=1, padding=wide // 2, count_include_pad=True)
    return (2 - around / (LIGHT_WINDOW**2 * MOST_LIGHT)).clamp(0, 1)
