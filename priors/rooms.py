"""Rendered rooms and streets at night whose lamps are in view, each lamp apart; in torch, on any device.

Panoramas show few lamps, and not how their light falls off. Here lamps have any size and power, so how much brighter
than white a lamp is follows from its size in the photo and from what it lights, as in a real room.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

LAMPS = 6  # Of a room; a photo switches on some of them
WALLS, BOXES, SPHERES = 6, 10, 4  # Things of a room before its lamps
PIXELS, SAMPLES = 192, 2  # Of a rendered view; samples on a side of a pixel
AT_ONCE = 25  # Rooms that are rendered at once
ROOM_SIZES, ROOM_HEIGHTS = (2.5, 9.0), (2.2, 4.0)  # Meters
THICKNESS = 0.2  # Meters, of a wall
STREET_SHARE = 0.3  # Of the rooms, those without ceiling and three walls, under a dark sky
LAMP_RADII, TUBE_LENGTHS, PANEL_SIZES = (0.01, 0.15), (0.2, 1.5), (0.15, 0.9)  # Meters; half sides of panels
TUBE_SHARE, PANEL_SHARE, SCREEN_SHARE = 0.15, 0.35, 0.6  # Of the lamps; the last: of the panels, those of colored cells
SPREAD_STOPS = 1.5  # By how many stops lamps of one kind differ in radiance, a standard deviation
TUBE_STOPS, PANEL_STOPS, SCREEN_STOPS = -2.0, -2.5, -5.0
"""Radiance of tubes, panels and screens over that of bulbs of BULB_RADIUS. Typical luminances are 50000 cd/m^2 of a
frosted bulb, 12000 of a fluorescent tube, 9000 of a ceiling panel and 300 to 1500 of a screen."""
BULB_RADIUS = 0.03  # Meters; larger bulbs are darker by their radius, as with shades around them
AROUND_STOPS = (-9.0, 1.0)  # Light from everywhere over what lamps lend the walls
COLORED_SHARE = 0.2  # Of the lamps, those of saturated color
GLOSSY_SHARE = 0.3  # Of the things, those that reflect lamps
SMALLEST_CROP = 0.6  # Share of a view's width
BOUNCE_BLUR = 9  # Pixels over which light from surfaces is averaged
FAR = 1e4


@dataclass(frozen=True)
class Things:
    """Boxes and spheres of rooms; a sphere is a thing whose `round` is set.

    low, high: [B, N, 3] corners. round: [B, N] bool. albedo, other: [B, N, 3], the two colors of a pattern. pitch:
    [B, N] of the pattern, meters. gloss: [B, N], the share of light that is reflected as by a mirror.
    """

    low: Tensor
    high: Tensor
    round: Tensor
    albedo: Tensor
    other: Tensor
    pitch: Tensor
    gloss: Tensor


@dataclass(frozen=True)
class Hits:
    """First hits of rays: distance [B, R], normal [B, R, 3], index [B, R] of the thing."""

    distance: Tensor
    normal: Tensor
    index: Tensor


class LitRooms:
    """Views of random rooms, [R, LAMPS + 1, 3, PIXELS, PIXELS]: of each lamp, and of light from everywhere."""

    def __init__(self, count: int, device: torch.device | str, seed: int):
        """Render `count` rooms: 1000 take 40 s on an H100 beside other work and about an hour on a CPU core."""
        self.generator = torch.Generator(device=device).manual_seed(seed)
        views, areas, stops, walls = [], [], [], []
        for first in range(0, count, AT_ONCE):
            rooms = Rooms(min(AT_ONCE, count - first), self.generator)
            views.append(rooms.render(PIXELS, SAMPLES))
            areas.append(rooms.lamp_areas())
            stops.append(rooms.lamp_stops)
            walls.append(2 * _faces(rooms.size).sum(1))
        self.views, self.areas, self.stops, self.walls = (torch.cat(v) for v in (views, areas, stops, walls))

    def take(self, count: int, size: int) -> Tensor:
        """Return radiance [B, 3, size, size] of parts of random views, by random lamps."""
        index = torch.randint(len(self.views), (count,), generator=self.generator, device=self.views.device)
        views = (self.views[index] * self._radiance(index)[..., None, None]).sum(1)
        part = SMALLEST_CROP + (1 - SMALLEST_CROP) * float(self._uniform(1))
        side = round(part * PIXELS)
        top, left = ((self._uniform(2) * (PIXELS - side + 1)).long()).tolist()
        views = F.interpolate(views[..., top : top + side, left : left + side], size=(size, size), mode="area")
        return torch.where(self._uniform(count, 1, 1, 1) < 0.5, views.flip(3), views)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.views.device)

    def _radiance(self, index: Tensor) -> Tensor:
        """Return radiance [B, LAMPS + 1, 3] of the lamps of rooms, some off, and of the light from everywhere."""
        areas, count = self.areas[index], len(index)
        random = torch.randn(areas.shape, generator=self.generator, device=areas.device)
        light = torch.exp2(self.stops[index] + SPREAD_STOPS * random)
        is_on = self._uniform(count, LAMPS) < self._uniform(count, 1)
        is_on[:, 0] = True  # The lamp that most cameras look at
        color = torch.exp2(self._uniform(count, LAMPS, 3) - 0.5)
        saturated = 3 * torch.softmax(5 * self._uniform(count, LAMPS, 3), 2)
        color = torch.where(self._uniform(count, LAMPS, 1) < COLORED_SHARE, saturated, color)
        lamps = (light * is_on)[..., None] * color
        # About what lamps lend the walls, times a random factor.
        around = (lamps * areas[..., None]).sum(1, keepdim=True) / self.walls[index][:, None, None]
        around = around * torch.exp2(AROUND_STOPS[0] + (AROUND_STOPS[1] - AROUND_STOPS[0]) * self._uniform(count, 1, 1))
        return torch.cat([lamps, around * torch.exp2(self._uniform(count, 1, 3) - 0.5)], 1)


class Rooms:
    """A few random rooms, of one view each."""

    def __init__(self, count: int, generator: torch.Generator):
        """Draw their things and lamps."""
        self.count, self.device, self.generator = count, generator.device, generator
        self._furnish()

    def _uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        values = torch.rand(self.count, *shape, generator=self.generator, device=self.device)
        return low + (high - low) * values

    def _log_uniform(self, *shape: int, between: tuple[float, float]) -> Tensor:
        return between[0] * (between[1] / between[0]) ** self._uniform(*shape)

    def _furnish(self) -> None:
        count = self.count
        size = torch.cat(
            [
                self._log_uniform(1, 2, between=ROOM_SIZES),
                self._uniform(1, 1, low=ROOM_HEIGHTS[0], high=ROOM_HEIGHTS[1]),
            ],
            2,
        )
        is_street = self._uniform(1, 1) < STREET_SHARE
        # Walls are boxes around the room; those that a street lacks are below its ground.
        zero = torch.zeros_like(size)
        axes = torch.eye(3, device=self.device)
        walls = [(zero - THICKNESS * axis, size * (1 - axis)) for axis in axes]
        walls += [(size * axis, size + THICKNESS * axis) for axis in axes]
        walls = [
            (torch.where(is_street, low - FAR, low), torch.where(is_street, high - FAR, high))
            if index in (0, 3, 5)  # One at each end of two axes, and the ceiling
            else (low, high)
            for index, (low, high) in enumerate(walls)
        ]
        half = self._log_uniform(BOXES, 3, between=(0.03, 0.7))
        flat = self._uniform(BOXES, 1) < 0.3
        half = torch.where(flat & (axes[2] > 0), 0.02, half)  # Tables and shelves
        middle = self._uniform(BOXES, 3) * size
        on_floor = self._uniform(BOXES) < 0.5
        middle[..., 2] = torch.where(on_floor, half[..., 2], middle[..., 2])
        radius = self._log_uniform(SPHERES, 1, between=(0.04, 0.4)).expand(-1, -1, 3)
        ball = self._uniform(SPHERES, 3) * size
        lamp_half, lamp_round, screen = self._lamp_shapes()
        lamp = (0.05 + 0.9 * self._uniform(LAMPS, 3)) * size
        lamp[..., 2] = (0.25 + 0.7 * self._uniform(LAMPS)) * size[..., 2]
        low = torch.cat([*(w[0] for w in walls), middle - half, ball - radius, lamp - lamp_half], 1)
        high = torch.cat([*(w[1] for w in walls), middle + half, ball + radius, lamp + lamp_half], 1)
        number = low.shape[1]
        is_round = torch.zeros(count, number, dtype=torch.bool, device=self.device)
        is_round[:, -LAMPS - SPHERES : -LAMPS] = True
        is_round[:, -LAMPS:] = lamp_round
        gray = self._log_uniform(number, 1, between=(0.04, 0.9))
        tint = 1 - self._uniform(number, 1) ** 2 * self._uniform(number, 3)
        contrast = torch.where(self._uniform(number, 1) < 0.5, self._log_uniform(number, 3, between=(0.15, 1)), 1.0)
        gloss = torch.where(self._uniform(number) < GLOSSY_SHARE, self._log_uniform(number, between=(0.02, 0.6)), 0.0)
        gloss[:, -LAMPS:] = 0
        pitch = self._log_uniform(number, between=(0.02, 1.0))
        self.things = Things(low, high, is_round, gray * tint, gray * tint * contrast, pitch, gloss)
        self.lamps = number - LAMPS
        self.is_screen = screen
        self.lamp_middle, self.lamp_half, self.lamp_round = lamp, lamp_half, lamp_round
        self.size = size[:, 0]

    def _lamp_shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return half sizes [B, LAMPS, 3], which lamps are spheres, and which are screens."""
        kind = self._uniform(LAMPS, 1)
        is_tube, is_panel = kind < TUBE_SHARE, kind > 1 - PANEL_SHARE
        half = self._log_uniform(LAMPS, 1, between=LAMP_RADII).expand(-1, -1, 3)
        axis = torch.randint(3, (self.count, LAMPS, 1), generator=self.generator, device=self.device)
        along = torch.arange(3, device=self.device) == axis
        tube = torch.where(along, self._log_uniform(LAMPS, 1, between=TUBE_LENGTHS) / 2, half.clamp_max(0.03))
        panel = torch.where(along, 0.01, self._log_uniform(LAMPS, 3, between=PANEL_SIZES))
        half = torch.where(is_tube, tube, torch.where(is_panel, panel, half))
        is_screen = is_panel & (self._uniform(LAMPS, 1) < SCREEN_SHARE)
        stops = torch.where(is_panel, PANEL_STOPS, -(half[..., :1] / BULB_RADIUS).log2())
        self.lamp_stops = torch.where(is_tube, TUBE_STOPS, torch.where(is_screen, SCREEN_STOPS, stops))[..., 0]
        return half, ~(is_tube | is_panel)[..., 0], is_screen[..., 0]

    def lamp_areas(self) -> Tensor:
        """Return the areas [B, LAMPS] of the surfaces of lamps."""
        half = self.lamp_half
        return torch.where(self.lamp_round, 4 * math.pi * half[..., 0] ** 2, _faces(half).sum(2) * 2)

    @torch.no_grad()
    def render(self, pixels: int, samples: int) -> Tensor:
        """Return [B, LAMPS + 1, 3, pixels, pixels]: each lamp of radiance 1, and light of 1 from everywhere.

        samples: a side of the square of samples of a pixel. Light that surfaces send is averaged over some pixels, and
        from the third surface on it is the same everywhere.
        """
        origin, directions = self._cameras(pixels, samples)
        direct, bounce, albedo = (torch.zeros(1, device=self.device) for _ in range(3))
        for direction in directions:
            hits = self.trace(origin[:, None].expand_as(direction), direction)
            place = origin[:, None] + hits.distance[..., None] * direction
            seen, light, color = self._shade(place, direction, hits)
            mirrored = direction - 2 * (direction * hits.normal).sum(2, keepdim=True) * hits.normal
            behind = self.trace(place + 1e-3 * hits.normal, mirrored)
            at = place + behind.distance[..., None] * mirrored
            shine, reflected, other = self._shade(at, mirrored, behind)
            gloss = self._at(self.things.gloss, hits.index)[..., None, None]
            gloss = gloss * (hits.distance < FAR)[..., None, None]
            direct = direct + seen + color[:, :, None] * light + gloss * (shine + other[:, :, None] * reflected)
            onward = self._cosine(hits.normal)
            next_hits = self.trace(place + 1e-3 * hits.normal, onward)
            next_place = place + next_hits.distance[..., None] * onward
            glow, second, next_color = self._shade(next_place, onward, next_hits)
            glow[:, :, :LAMPS] = 0  # Lamps are in `light`
            bounce = bounce + glow + next_color[:, :, None] * second
            albedo = albedo + color
        direct, bounce, albedo = (values / len(directions) for values in (direct, bounce, albedo))
        shape = (self.count, pixels, pixels, LAMPS + 1, -1)
        direct, bounce = (v.reshape(shape).permute(0, 3, 4, 1, 2) for v in (direct, bounce))
        bounce = bounce.expand(-1, -1, 3, -1, -1)
        bounce = F.avg_pool2d(
            bounce.flatten(1, 2), BOUNCE_BLUR, 1, BOUNCE_BLUR // 2, count_include_pad=False
        ).reshape_as(bounce)
        albedo = albedo.reshape(self.count, 1, pixels, pixels, 3).permute(0, 1, 4, 2, 3)
        mean = albedo.mean((3, 4), keepdim=True)
        further = bounce.mean((3, 4), keepdim=True) * mean / (1 - mean)
        return direct + albedo * (bounce + further)

    def _cameras(self, pixels: int, samples: int) -> tuple[Tensor, list[Tensor]]:
        """Return places [B, 3] and, for each sample of a pixel, directions [B, pixels^2, 3]."""
        place = (0.05 + 0.9 * self._uniform(3)) * self.size
        place[:, 2] = self._uniform(low=0.8, high=1.8)
        target = torch.where(self._uniform(1) < 0.75, self.lamp_middle[:, 0], self._uniform(3) * self.size)
        ahead = F.normalize(target - place + 0.3 * (self._uniform(3) - 0.5), dim=1)
        up = torch.tensor([0.0, 0.0, 1.0], device=self.device).expand_as(ahead)
        right = F.normalize(torch.linalg.cross(ahead, up), dim=1)
        down = torch.linalg.cross(ahead, right)
        half = torch.tan(torch.deg2rad(self._uniform(1, low=35, high=80)) / 2)[..., None]
        turn = self._uniform(2, low=-0.3, high=0.3)
        directions = []
        steps = torch.arange(pixels, device=self.device)
        for k in range(samples**2):
            part = [(k % samples + 0.5) / samples, (k // samples + 0.5) / samples]
            across = 2 * (steps + part[0]).repeat(pixels) / pixels - 1
            below = 2 * (steps + part[1]).repeat_interleave(pixels) / pixels - 1
            x, y = half * across[None, :, None] + turn[:, None, :1], half * below[None, :, None] + turn[:, None, 1:]
            directions.append(F.normalize(ahead[:, None] + x * right[:, None] + y * down[:, None], dim=2))
        return place, directions

    def _at(self, values: Tensor, index: Tensor) -> Tensor:
        """Return values [B, N, ...] of things at indices [B, R]."""
        if values.ndim == 2:
            return values.gather(1, index)
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[2]))

    def trace(self, origin: Tensor, direction: Tensor) -> Hits:
        """Return what rays [B, R, 3] meet first."""
        best = torch.full(origin.shape[:2], FAR, device=self.device)
        index = torch.zeros(origin.shape[:2], dtype=torch.long, device=self.device)
        inverse = 1 / torch.where(direction.abs() < 1e-9, 1e-9, direction)
        for k in range(self.things.low.shape[1]):
            distance = self._distance(origin, direction, inverse, k)
            nearer = distance < best
            best = torch.where(nearer, distance, best)
            index = torch.where(nearer, k, index)
        low, high = self._at(self.things.low, index), self._at(self.things.high, index)
        middle, half = (low + high) / 2, ((high - low) / 2).clamp_min(1e-6)
        away = (origin + best[..., None] * direction - middle) / half
        axis = F.one_hot(away.abs().argmax(2), 3) * away.sign()
        normal = torch.where(self._at(self.things.round, index)[..., None], F.normalize(away, dim=2), axis)
        facing = (normal * direction).sum(2, keepdim=True)
        return Hits(best, torch.where(facing > 0, -normal, normal), index)

    def _distance(self, origin: Tensor, direction: Tensor, inverse: Tensor, k: int) -> Tensor:
        """Return [B, R] the distances at which rays meet thing k, FAR if they do not."""
        low, high = self.things.low[:, k, None], self.things.high[:, k, None]
        first, second = (low - origin) * inverse, (high - origin) * inverse
        enter, leave = torch.minimum(first, second).amax(2), torch.maximum(first, second).amin(2)
        box = torch.where(enter > 1e-4, enter, leave)
        box = torch.where((leave >= enter - 1e-6) & (box > 1e-4), box, FAR)
        if k < self.things.low.shape[1] - LAMPS - SPHERES:
            return box
        away = origin - (low + high) / 2
        half = (away * direction).sum(2)
        root = half.square() - away.square().sum(2) + ((high - low)[..., 0] / 2) ** 2
        near = -half - root.clamp_min(0).sqrt()
        ball = torch.where((root > 0) & (near > 1e-4), near, FAR)
        return torch.where(self.things.round[:, k, None], ball, box)

    def _shade(self, place: Tensor, direction: Tensor, hits: Hits) -> tuple[Tensor, Tensor, Tensor]:
        """Return what rays see at places [B, R, 3]: light that is sent there, what lamps send there, and the albedo.

        Light is [B, R, LAMPS + 1, 3] and [B, R, LAMPS + 1, 1 or 3], divided by pi; the albedo is [B, R, 3].
        """
        things, count = self.things, LAMPS + 1
        missed = hits.distance >= FAR
        lamp = hits.index - self.lamps
        sent = F.one_hot(lamp.clamp_min(-1) + 1, count)[..., 1:].float() * ~missed[..., None]
        low = self._at(things.low, hits.index)
        is_screen = torch.cat([torch.zeros_like(things.pitch[:, : self.lamps]), self.is_screen.float()], 1)
        cells = 3 * torch.softmax(2.5 * _noise(place - low, self._at(things.pitch, hits.index)), 2)
        cells = torch.where((self._at(is_screen, hits.index) > 0)[..., None], cells, 1.0)
        sent = sent[..., None] * cells[:, :, None]
        sky = missed[..., None, None].float().expand(-1, -1, 1, 3)
        sent = torch.cat([sent, sky], 2)
        light = [self.light_from_lamp(k, place, hits.normal) for k in range(LAMPS)]
        around = 0.6 + 0.4 * hits.normal[..., 2]
        pattern = _noise(place, self._at(things.pitch, hits.index))[..., :1]
        color = torch.where(pattern > 0, self._at(things.albedo, hits.index), self._at(things.other, hits.index))
        color = color * (~missed & (lamp < 0))[..., None]
        return sent, torch.stack([*light, around], 2)[..., None], color

    def light_from_lamp(self, k: int, place: Tensor, normal: Tensor) -> Tensor:
        """Return [B, R] the irradiance over pi at places from a random point of a lamp of radiance 1."""
        random = torch.rand(place.shape, generator=self.generator, device=self.device) * 2 - 1
        is_round = self.lamp_round[:, k, None, None]
        random = torch.where(is_round, 0.7 * F.normalize(random, dim=2), random)
        half = self.lamp_half[:, k, None]
        away = self.lamp_middle[:, k, None] + half * random - place
        distance = away.norm(dim=2).clamp_min(1e-3)
        direction = away / distance[..., None]
        area = torch.where(is_round[..., 0], math.pi * half[..., 0] ** 2, (direction.abs() * _faces(half)).sum(2))
        light = area * (direction * normal).sum(2).clamp_min(0) / (distance**2 + area / math.pi) / math.pi
        origin = place + 1e-3 * normal
        inverse = 1 / torch.where(direction.abs() < 1e-9, 1e-9, direction)
        reach = distance - half.amax(2) * 1.8 - 2e-3
        lit = torch.ones_like(light)
        for other in range(WALLS, self.lamps):
            lit = lit * (self._distance(origin, direction, inverse, other) > reach)
        return light * lit

    def _cosine(self, normal: Tensor) -> Tensor:
        """Return random directions [B, R, 3] about normals, distributed as the cosine."""
        random = torch.randn(normal.shape, generator=self.generator, device=self.device)
        return F.normalize(normal + 0.999 * F.normalize(random, dim=2), dim=2)


def _faces(half: Tensor) -> Tensor:
    """Return the areas [..., 3] of the faces of boxes of half sizes [..., 3]."""
    return 4 * half.roll(1, -1) * half.roll(2, -1)


def _noise(place: Tensor, pitch: Tensor) -> Tensor:
    """Return [B, R, 3] in [-1, 1], the same within cells of a pitch [B, R] at places [B, R, 3]."""
    cell = torch.floor((place + 1e-4) / pitch[..., None])
    mixed = cell @ cell.new_tensor([[12.9898, 39.425, 73.156], [78.233, 11.135, 52.235], [37.719, 83.155, 9.151]])
    return 2 * torch.frac((torch.sin(mixed) * 4375.85).abs()) - 1
