"""Morphological Chan-Vese (Marquez-Neila, Baumela & Alvarez 2014) on 64 pixels per machine word.

The curvature flow is a composition of two operators over the four line segments P of the 3x3
neighbourhood: SI(u) = sup_P inf_P u and IS(u) = inf_P sup_P u (their eq. 9 to 11). On bits a line's
infimum is the AND of its two ends with the centre, so an operator is a dozen word operations.
Beyond the image there is background, as in scikit-image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Singles
from mushpipe.core.jit import jit
from mushpipe.stages.chan_vese_fast import region_sums

Words = NDArray[np.uint64]


def pack(mask: Bools) -> Words:
    """Pack an (H, W) mask into (H, ceil(W / 64)) words, the leftmost pixel in the lowest bit."""
    height, width = mask.shape
    padded = mask.view(np.uint8)
    if width % 64:
        padded = np.zeros((height, -(-width // 64) * 64), np.uint8)
        padded[:, :width] = mask
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


def unpack(words: Words, width: int) -> Bools:
    """Undo `pack`."""
    bits = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
    return np.ascontiguousarray(bits[:, :width]).view(np.bool_)


@jit
def _east(words: Words, y: int, k: int) -> Any:
    """The word whose bits are the right neighbours; background beyond the image."""
    carry = words[y, k + 1] << np.uint64(63) if k + 1 < words.shape[1] else np.uint64(0)
    return (words[y, k] >> np.uint64(1)) | carry


@jit
def _west(words: Words, y: int, k: int) -> Any:
    carry = words[y, k - 1] >> np.uint64(63) if k > 0 else np.uint64(0)
    return (words[y, k] << np.uint64(1)) | carry


@jit
def curvature_step(words: Words, out: Words, tail: np.uint64, sup_first: bool) -> None:
    """Write SI of the words into out, or IS where ``sup_first``; ``tail`` masks the last word."""
    height, n = words.shape
    zero = np.uint64(0)
    for y in range(height):
        for k in range(n):
            c = words[y, k]
            w, e = _west(words, y, k), _east(words, y, k)
            up = nw = ne = down = sw = se = zero
            if y > 0:
                up, nw, ne = words[y - 1, k], _west(words, y - 1, k), _east(words, y - 1, k)
            if y + 1 < height:
                down, sw, se = words[y + 1, k], _west(words, y + 1, k), _east(words, y + 1, k)
            if sup_first:
                value = c | ((w | e) & (up | down) & (nw | se) & (ne | sw))
            else:
                value = c & ((w & e) | (up & down) | (nw & se) | (ne & sw))
            out[y, k] = value & tail if k == n - 1 else value


@jit
def attachment_step(words: Words, inside: Words, out: Words, width: int) -> None:
    """Take the bits of ``inside`` where the gradient of the words is not zero.

    The gradient is the central difference, one-sided at the border of the image.
    """
    height, n = words.shape
    one = np.uint64(1)
    last = np.uint64((width - 1) % 64)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for k in range(n):
            w, e = _west(words, y, k), _east(words, y, k)
            if k == 0:  # the leftmost pixel has itself as its left neighbour
                w |= words[y, 0] & one
            if k == n - 1:
                e |= words[y, k] & (one << last)
            band = (w ^ e) | (words[above, k] ^ words[below, k])
            out[y, k] = (words[y, k] & ~band) | (inside[y, k] & band)


@jit
def change_of_region(image: Singles, old: Words, new: Words) -> tuple[int, float]:
    """Return by how much the number of set pixels and the image's sum over them grew."""
    width = image.shape[1]
    count = 0
    total = 0.0
    for y in range(old.shape[0]):
        for k in range(old.shape[1]):
            changed = old[y, k] ^ new[y, k]
            x = 64 * k
            while changed != np.uint64(0):
                if changed & np.uint64(255) == np.uint64(0):  # changes are few and far between
                    changed >>= np.uint64(8)
                    x += 8
                    continue
                if changed & np.uint64(1) and x < width:
                    sign = 1 if (new[y, k] >> np.uint64(x - 64 * k)) & np.uint64(1) else -1
                    count += sign
                    total += sign * image[y, x]
                changed >>= np.uint64(1)
                x += 1
    return count, total


def solve_morphological(image: Singles, initial: Bools, iterations: int, smoothing: int) -> Bools:
    """Evolve a region through so many iterations.

    The operators alternate, so a region at rest swings between a few states: from the first that
    comes back on, the rest is known.

    Args:
        image: (H, W) in 0..1.
        initial: (H, W) region to start from.
        iterations: Number of iterations.
        smoothing: Curvature steps per iteration, the method's counterpart of mu.
    """
    width = image.shape[1]
    tail = np.uint64(2 ** ((width - 1) % 64 + 1) - 1)
    states, flip = [pack(initial)], False
    seen = {(states[0].tobytes(), flip): 0}
    nearer = np.empty(image.shape, bool)
    count, total, everything = region_sums(image, initial.view(np.uint8))
    for done in range(1, iterations + 1):
        if count in (0, image.size):
            break
        c1, c2 = total / count, (everything - total) / (image.size - count)
        (np.greater if c1 > c2 else np.less)(image, np.float32((c1 + c2) / 2), out=nearer)
        evolved = np.empty_like(states[-1])
        attachment_step(states[-1], pack(nearer), evolved, width)
        for _ in range(smoothing):
            evolved = _smooth(evolved, tail, flip)
            flip = not flip
        grown, added = change_of_region(image, states[-1], evolved)
        count, total = count + grown, total + added
        first = seen.setdefault((evolved.tobytes(), flip), done)
        if first < done:
            return unpack(states[first + (iterations - first) % (done - first)], width)
        states.append(evolved)
    return unpack(states[-1], width)


def _smooth(words: Words, tail: np.uint64, flip: bool) -> Words:
    """Apply SI(IS(u)), or IS(SI(u)) where ``flip``."""
    first, second = np.empty_like(words), np.empty_like(words)
    curvature_step(words, first, tail, not flip)
    curvature_step(first, second, tail, flip)
    return second
