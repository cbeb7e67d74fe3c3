"""Faults of an irradiance record: values that no daylight has, and changes that no cloud makes.

The spectra of a record judge one another: no model of the sky, no place and no time of the day enter.
"""

from types import SimpleNamespace

import numpy as np

from hyperpaint.base import (
    JUDGED_NM,
    Array,
    Bools,
    Floats,
    Indices,
    Problem,
    Problems,
    SchemaError,
    warn_user,
)

#: Limits beyond which values of an irradiance record are not daylight.
#:
#: Alarms were counted on the real records of the project, and on 160 simulated right ones (clear, dusk,
#: broken cloud, noise of 0.2 to 2 %, 2 to 4 digits, intervals of 1 to 60 s): none.
RULES = SimpleNamespace(
    # Irradiance of a single channel [W m-2 nm-1]: the sun above the atmosphere has at most 2.2, sides of
    # clouds add half of it. A higher value is a fill value where ``spike`` says so, too: it tells fill values
    # from wrong units.
    max_irradiance=5.0,
    # Value over the median of the record [1]: the brightest channels have 2.
    spike=4.0,
    # Share of the channels of a scan that hold one value [1]: no light has the same irradiance at all
    # wavelengths, a fill value has.
    flat_share=0.9,
    # Number of neighbouring channels to which a stuck channel is compared.
    window=41,
    # Share of the scans without a value from which a channel is left out of the record [1]; below, the scans
    # are left out instead.
    missing_share=0.1,
    # Number of neighbouring channels that equal the maximum of a scan, and all such channels over the
    # channels of the next most frequent value: rounding to 2 or 3 digits makes all values frequent.
    clipped_channels=5,
    clipped_excess=3.0,
    # Number of unequal scans from which a constant channel is judged, and change of its neighbours between
    # two scans in steps of their rounding: within fewer steps rounding holds a value.
    stuck_scans=6,
    stuck_steps=4.0,
    # Difference of even and odd channels [1]: 0.01 in real records.
    alternation=0.05,
    # Change of a scan against its neighbours in an interval of 100 nm, relative [1], and over the usual
    # change of the record: under broken clouds every scan is unlike its neighbours. The limit is at most
    # ``sure_change``, since few scans do not show what is usual.
    scan_change=0.05,
    scan_sds=8.0,
    sure_change=0.5,
    # Change from the scan before to the scan after, and between the quantiles ``most`` of the next
    # ``weather`` scans on both sides, over that of the scan between [1].
    steady=0.25,
    weather=8,
    most=(0.15, 0.85),
    # Light of up to ``weather`` scans in a row over the light of the scans around [1], under which the
    # shutter was closed: no cloud takes 99 %; share of the scans up to which such scans are left out [1]:
    # every second one.
    shutter=0.01,
    shutter_share=0.55,
    # Number of scans from which scans are compared with their neighbours.
    least_scans=5,
    # Longest time between the scans before and after [s]: a cloud of 100 m needs 7 s or more to pass.
    scan_s=6.0,
    # Relative level of a scan between two slow neighbours, and of the first and the last scan [1]: clouds
    # leave 0.2 of a clear sky, and gaps between them give back no more than 5 times.
    dark_scan=0.15,
    bright_scan=6.0,
    # Share of the scans that may be unlike their neighbours [1], at least two: more is weather.
    scan_share=0.05,
    # Change of level from one scan to the next [1]; difference of this change among intervals of 100 nm, over
    # it: clouds take sunlight, which is redder than skylight, so that theirs is 0.2 and more; change within
    # the three scans before and the three after, over it.
    step=0.05,
    step_colour=0.1,
    step_steady=0.15,
    # Share of channels, and of scans, that must remain [1].
    least_share=0.6,
)


#: Attribute of a record that was judged: codes and texts of its faults.
FAULTS_ATTR = "irradiance_faults"
#: What a fault of a record is told of: the record, whichever of its flight lines shows it.
RECORD = "irradiance record"
#: Number of scans whose median is the level of a channel.
_MAX_LEVEL_SCANS = 256
#: Number of channels that show the light of a scan, and whether all channels have one value.
_MAX_FLAT_CHANNELS = 100


def clipped_top(values: Floats) -> Bools:
    # Return the channels (scan, channel) of a flat top: many equal the maximum of their scan.
    clipped = np.zeros(values.shape, bool)
    top = np.max(values, axis=1, initial=-np.inf, where=np.isfinite(values))
    is_top = values == top[:, None]
    for number in np.flatnonzero(is_top.sum(axis=1) >= RULES.clipped_channels):
        row, at_top = values[number], is_top[number]
        edges = np.flatnonzero(np.diff(at_top, prepend=False, append=False))
        _, counts = np.unique(row[(row > 0.5 * top[number]) & ~at_top], return_counts=True)
        clipped[number] = at_top & (
            (edges[1::2] - edges[::2]).max() >= RULES.clipped_channels
            and at_top.sum() <= RULES.flat_share * (row > 0.0).sum()
            and at_top.sum() >= RULES.clipped_excess * counts.max(initial=1)
        )
    return clipped


def judge_record(
    wavelength: Floats, times: Array, values: Array, clipped: Bools | None = None
) -> tuple[Floats, tuple[Problem, ...]]:
    # Return the values of an irradiance record that can be daylight (scan, channel), NaN where left out, and
    # its faults by kind.
    #
    # ``wavelength`` (channel,) [nm]; ``times`` (scan,), which increase; ``values`` (scan, channel)
    # [W m-2 nm-1], NaN where undefined; ``clipped`` (scan, channel): channels whose raw counts were clipped.
    #
    # Channels of 400 to 1000 nm are judged: beyond, noise may exceed the light. Raises SchemaError: fewer
    # channels or scans than `RULES.least_share` remain.
    values = np.array(values, np.float64)
    values[np.isinf(values)] = np.nan  # such as counts over a gain of zero
    in_light = (wavelength >= JUDGED_NM[0]) & (wavelength <= JUDGED_NM[1])
    judged = in_light if in_light.any() else np.ones(wavelength.size, bool)
    faults: list[Problem] = []
    stamps = np.datetime_as_string(times.astype("datetime64[ns]"), "ms")
    sampled = np.flatnonzero(judged)[:: max(1, judged.sum() // _MAX_FLAT_CHANNELS)]
    light = _median(values[:, sampled], axis=1)
    is_dark = _shutter_scans(light)
    if is_dark.any():
        first = int(np.argmax(is_dark))
        faults.append(
            Problem(
                f"{is_dark.sum()} of {len(values)} scans are left out: values are zero or under "
                f"{100 * RULES.shutter:g} % of the scans around, as behind a closed shutter, such as "
                f"{light[first]:.4g} at {stamps[first]}",
                code="irradiance-scans",
            )
        )
        values[is_dark] = np.nan
    defined = np.isfinite(values)
    lost_scans, lost_channels = np.zeros(len(values), bool), np.zeros(wavelength.size, bool)

    def leave_out(is_wrong: Bools, reason: str) -> None:
        # single values become NaN; channels are lost that miss them in many scans, else the scans are
        nonlocal lost_scans, lost_channels
        is_new = is_wrong & np.isfinite(values)
        if not is_new.any():
            return
        is_new &= judged
        whole = is_new.sum(axis=1) > (1.0 - RULES.missing_share) * judged.sum()
        channels = is_new[~whole].sum(axis=0) > RULES.missing_share * max((~whole).sum(), 1)
        # scans in which most of the values are of these channels: the others are their borders
        usual = is_new[:, channels].sum(axis=1) > 0.5 * is_new.sum(axis=1)
        channels |= is_new[usual & ~whole].any(axis=0)
        scans = is_new[:, ~channels].any(axis=1)
        first = int(np.argmax(scans))
        example = values[first][is_new[first] & ~channels][:1]
        lost_scans, lost_channels = lost_scans | scans, lost_channels | channels
        values[is_wrong | channels] = np.nan
        if channels.any():
            nm = wavelength[channels]
            faults.append(
                Problem(
                    f"{nm.size} channels between {nm[0]:g} and {nm[-1]:g} nm are {reason}, and are left out",
                    code="irradiance-channels",
                )
            )
        if scans.any():
            text = f"{scans.sum()} of {len(values)} scans are left out: values are {reason}, such as "
            faults.append(Problem(f"{text}{example[0]:.4g} at {stamps[first]}", code="irradiance-scans"))

    rows = np.unique(np.linspace(0, len(values) - 1, min(len(values), _MAX_LEVEL_SCANS)).astype(int))
    leave_out(~(values > 0.0), "zero, negative (darker than the dark) or a fill value")
    sample = values[:, sampled]
    is_flat = (sample == _median(sample, axis=1)[:, None]).mean(axis=1) > RULES.flat_share
    is_flat &= is_flat.sum() < 0.5 * np.isfinite(values).any(axis=1).sum()  # not a made-up record
    leave_out(np.broadcast_to(is_flat[:, None], values.shape), "a fill value: the same in all channels")
    level = float(np.nan_to_num(_median(_median(values[rows][:, judged], axis=0)[None], axis=1)[0]))
    leave_out(values > max(RULES.max_irradiance, RULES.spike * level), "a fill value, above any sunlight")
    clipped = clipped_top(values) if clipped is None else clipped | clipped_top(values)
    leave_out(clipped, "clipped: equal at the maximum of the scan, as saturated counts are")
    # Channels that never change between unequal scans, while those around them do, beyond their rounding;
    # ``rows`` are the scans that are compared
    change = np.abs(np.diff(values[rows], axis=0))
    change = change[(change > 0.0).any(axis=1)]
    stuck = np.zeros(values.shape, bool)
    if len(change) >= RULES.stuck_scans:
        is_constant = (change == 0.0).all(axis=0)
        changes = np.where(is_constant, np.nan, _median(change, axis=0))
        steps = np.min(change, axis=0, initial=np.inf, where=change > 0.0)
        moves = _smooth(changes) >= RULES.stuck_steps * _smooth(np.where(is_constant, np.nan, steps))
        stuck[:] = is_constant & moves
    leave_out(stuck, "stuck: equal in all scans, while their neighbours change")
    # too little is left; values that were undefined before do not count
    channels = 1.0 - lost_channels[judged].mean()
    scans = 1.0 - lost_scans.sum() / max(int(defined.any(axis=1).sum()), 1)
    spectrum = np.log(_median(values[rows], axis=0)[judged])
    excess = spectrum[1:-1] - 0.5 * (spectrum[:-2] + spectrum[2:])
    excess[::2] *= -1.0
    alternation = abs(float(_median(excess[:, None], axis=0)[0])) if excess.size > RULES.window else 0.0
    Problems("the irradiance record is not daylight", SchemaError).raise_if_any(
        (
            min(channels, scans) < RULES.least_share,
            Problem(
                f"{100 * channels:.0f} % of the channels and {100 * scans:.0f} % of the scans remain: "
                + "; ".join(fault.found for fault in faults),
                expected=f"at least {100 * RULES.least_share:g} %",
                mend="check the spectrometer and the conversion of its files; leave faulty files out",
                code="irradiance-lost",
            ),
        ),
        (
            alternation > RULES.alternation,
            Problem(
                f"every second channel is {np.exp(-alternation):.3g} times its neighbours",
                expected="a smooth spectrum",
                mend="check the spectrometer and the conversion of its files",
                code="irradiance-lost",
            ),
        ),
    )
    # levels in intervals of 100 nm of the scans that remain
    used = judged & (np.isnan(values).mean(axis=0) <= RULES.missing_share)
    complete = np.flatnonzero(np.isfinite(values[:, used]).all(axis=1)) if used.any() else np.zeros(0, int)
    if complete.size >= RULES.least_scans:
        interval = np.floor(np.minimum(wavelength[used], 999.0) / 100.0)
        sums = [values[complete][:, used][:, interval == i].sum(axis=1) for i in np.unique(interval)]
        levels = np.log(np.stack(sums, axis=1))
        ticks = times[complete].astype("datetime64[ns]").astype(np.int64)
        unlike = complete[_unlike_scans(levels, ticks / 1e9)]
        if unlike.size:
            when = ", ".join(stamps[unlike][:5])
            faults.append(
                Problem(
                    f"{unlike.size} of {len(values)} scans are left out: unlike their neighbours, at {when}",
                    code="irradiance-scans",
                )
            )
            values[unlike] = np.nan
        is_kept = ~np.isin(complete, unlike)
        step = _step(levels[is_kept])
        if step is not None:
            number, factor = step
            when = stamps[complete[is_kept][number + 1]]
            faults.append(
                Problem(
                    f"step in gain at {when}: all channels change by the factor {factor:.3g} "
                    "between two scans",
                    code="irradiance-step",
                )
            )
    return values, tuple(faults)


def _median(values: Floats, axis: int) -> Floats:
    # Median of the finite values; NaN without any, without numpy's warning
    is_empty = ~np.isfinite(values).any(axis=axis)
    filled = np.where(np.expand_dims(is_empty, axis), 0.0, values)
    return np.where(is_empty, np.nan, np.nanmedian(filled, axis=axis))


def _smooth(level: Floats) -> Floats:
    # Running median of a spectrum over its channels with values; infinite without any
    from scipy import ndimage

    known = np.flatnonzero(np.isfinite(level))
    if not known.size:
        return np.full(level.shape, np.inf)
    smooth = ndimage.median_filter(level[known], min(RULES.window, known.size), mode="nearest")
    return np.asarray(np.interp(np.arange(level.size), known, smooth))


def _shutter_scans(light: Floats) -> Bools:
    # Return the scans in valleys of the light (scan,) that no cloud makes; fill values are no light
    from scipy import ndimage

    median = _median(light[None], axis=1)[0]
    known = light <= max(RULES.max_irradiance, RULES.spike * float(np.nan_to_num(median)))
    is_dark = np.zeros(light.shape, bool)
    if known.any():
        top = max(float(np.quantile(light[known], 0.9)), 0.0)
        level = np.clip(light[known], 0.0, top)
        # a closing fills valleys of fewer scans and keeps wider ones, in which noise is no light
        around = ndimage.grey_closing(level, RULES.weather + 1)
        is_dark[known] = (level < RULES.shutter * around) & (around > RULES.shutter * top)
    return is_dark if is_dark.mean() <= RULES.shutter_share else np.zeros(light.shape, bool)


def _unlike_scans(levels: Floats, seconds: Floats) -> Indices:
    # Numbers of up to three scans in a row that differ from the scans before and after, which agree.
    # ``levels`` (scan, interval) are logarithms. Too many such scans are weather, and stay.
    count = len(levels)
    unlike = np.zeros(count, bool)
    bend = np.abs(levels[1:-1] - 0.5 * (levels[:-2] + levels[2:])).max(axis=1)
    limit = min(max(RULES.scan_change, RULES.scan_sds * float(np.median(bend))), RULES.sure_change)
    low, high = np.log(RULES.dark_scan), np.log(RULES.bright_scan)
    is_edge = np.abs(np.diff(levels, axis=0)).max(axis=1) > 0.5 * limit
    starts = np.unique([0, *(np.flatnonzero(is_edge) + 1).tolist()])
    for length in (1, 2, 3):
        for first in starts[starts <= count - length].tolist():
            stop = first + length
            run = slice(first, stop)
            if first == 0 or stop == count:  # one-sided: four neighbours on the inner side
                around = levels[stop : stop + 4] if first == 0 else levels[max(first - 4, 0) : first]
                is_fast = False
            else:
                around = levels[[first - 1, stop]]
                is_fast = seconds[stop] - seconds[first - 1] <= RULES.scan_s
            wide = np.concatenate([levels[:first][-RULES.weather :], levels[stop:][: RULES.weather]])
            spread = np.diff(np.quantile(wide, RULES.most, axis=0), axis=0).max()
            change = levels[run] - around.mean(axis=0)
            size = float(np.abs(change).max(axis=1).min())
            unsteady = max(np.ptp(around, axis=0).max(), spread)
            if size <= limit or unsteady > RULES.steady * size or unlike[run].any():
                continue
            mean = change.mean(axis=1)
            unlike[run] = is_fast or (length == 1 and not low <= mean[0] <= high)
    numbers = np.flatnonzero(unlike)
    return numbers if numbers.size <= max(2, RULES.scan_share * count) else numbers[:0]


def _step(levels: Floats) -> tuple[int, float] | None:
    # Number of the scan before the largest step of all intervals by one factor, and the factor; None without
    found: tuple[int, float] | None = None
    changes = np.diff(levels, axis=0)
    candidates = np.flatnonzero(np.abs(changes.mean(axis=1)) > RULES.step)
    for number in candidates[(candidates >= 2) & (candidates < len(levels) - 3)].tolist():
        change = changes[number]
        size = abs(float(change.mean()))
        around = max(
            np.ptp(levels[number - 2 : number + 1], axis=0).max(),
            np.ptp(levels[number + 1 : number + 4], axis=0).max(),
        )
        is_grey = np.ptp(change) < RULES.step_colour * size
        if is_grey and around < RULES.step_steady * size and (found is None or size > abs(np.log(found[1]))):
            found = number, float(np.exp(change.mean()))
    return found


def warn_of_faults(faults: tuple[Problem, ...]) -> None:
    # Warn of the faults of a record.
    for fault in faults:
        warn_user(f"{RECORD}: {fault.found}", fault.code)
