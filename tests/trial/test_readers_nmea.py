"""NMEA 0183: values against pynmea2, times, damage."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pynmea2
import pytest

from greybox.errors import LogError
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.readers.nmea import read_nmea
from greybox.vessel.toml import vessel_from_dict

KN = 1852 / 3600


def sentence(body):
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}\r\n"


def clock(seconds):
    whole = seconds % 86400
    return f"{int(whole) // 3600:02}{int(whole) // 60 % 60:02}{whole % 60:05.2f}"


def gga(seconds, lat="6325.5000,N", lon="01024.2500,E", fix=1):
    return sentence(f"GPGGA,{clock(seconds)},{lat},{lon},{fix},9,1.0,5.0,M,40.0,M,,")


def rmc(seconds, date="010624", status="A", lat="6325.5000,N", lon="01024.2500,E"):
    return sentence(f"GPRMC,{clock(seconds)},{status},{lat},{lon},5.0,45.0,{date},,,A")


def read(tmp_path, *lines):
    path = tmp_path / "x.nmea"
    path.write_bytes("".join(lines).encode("latin-1"))
    return read_nmea(path)


def minute(*extra, start=36000):
    return [line for k in range(60) for line in (gga(start + k), rmc(start + k), *extra)]


def test_positions_against_pynmea2(tmp_path):
    rng = np.random.default_rng(0)
    lines, wanted = [], []
    for k in range(200):
        lat, lon = rng.uniform(0, 90), rng.uniform(0, 180)
        a = f"{int(lat):02}{lat % 1 * 60:09.6f}".replace("60.000000", "59.999999")
        b = f"{int(lon):03}{lon % 1 * 60:09.6f}".replace("60.000000", "59.999999")
        line = gga(k, f"{a},{'NS'[k % 2]}", f"{b},{'EW'[k // 2 % 2]}")
        lines.append(line)
        found = pynmea2.parse(line.strip())
        wanted.append((found.latitude, found.longitude))
    recording = read(tmp_path, *lines)
    north, east = np.array(wanted).T
    np.testing.assert_allclose(recording["lat"].value, north, atol=1e-12)
    np.testing.assert_allclose(recording["lon"].value, east, atol=1e-12)
    assert recording["lat"].t.tolist() == list(range(200))


VALUES = {
    "HEHDT,123.4,T": ("psi", "heading", np.pi / 180),
    "TIROT,-12.5,A": ("r", "rate_of_turn", np.pi / 180 / 60),
    "GPVTG,45.5,T,,M,5.5,N,10.2,K,A": ("sog", "spd_over_grnd_kts", KN),
    "WIMWV,214.8,R,7.5,N,A": ("dir_q", "wind_angle", np.pi / 180),
    "WIMWV,214.8,T,7.5,N,A": ("dir_t", "wind_angle", np.pi / 180),
    "IIRPM,S,2,120.5,80.0,A": ("rpm_shaft2", "speed", 1),
    "IIRPM,E,1,-900,80.0,A": ("rpm_engine1", "speed", 1),
    "AGRSA,-10.5,A,11.5,A": ("rudder_starboard", "rsa_starboard", np.pi / 180),
    "WIMWD,214.8,T,210,M,7.5,N,3.9,M": ("V_w", "wind_speed_meters", 1),
}


@pytest.mark.parametrize("body", VALUES)
def test_values_against_pynmea2(tmp_path, body):
    name, field, factor = VALUES[body]
    wanted = float(getattr(pynmea2.parse(sentence(body).strip()), field)) * factor
    recording = read(tmp_path, *minute(sentence(body)))
    np.testing.assert_allclose(recording[name].value, wanted, rtol=1e-12)
    assert len(recording[name]) == 60


@pytest.mark.parametrize("reference", ["R", "T"])
@pytest.mark.parametrize(("unit", "factor"), [("N", KN), ("M", 1), ("K", 1 / 3.6), ("S", 0.44704)])
def test_wind_in_every_unit(tmp_path, reference, unit, factor):
    recording = read(tmp_path, *minute(sentence(f"WIMWV,30,{reference},8.0,{unit},A")))
    speed, angle = ("V_q", "dir_q") if reference == "R" else ("V_w", "dir_t")
    np.testing.assert_allclose(recording[speed].value, 8 * factor)
    np.testing.assert_allclose(recording[angle].value, np.radians(30))


@pytest.mark.parametrize(("side", "sign"), [("L", -1), ("R", 1)])
def test_relative_wind_of_either_side(tmp_path, side, sign):
    recording = read(tmp_path, *minute(sentence(f"WIVWR,40,{side},10.0,N,,M,,K")))
    np.testing.assert_allclose(recording["V_q"].value, 10 * KN)
    np.testing.assert_allclose(recording["dir_q"].value, sign * np.radians(40))


def test_headings_of_every_kind(tmp_path):
    true = read(tmp_path, *minute(sentence("HETHS,50.0,A"), sentence("HEHDT,51.0,T")))
    np.testing.assert_allclose(true["psi"].value, np.radians(50))
    dead = read(tmp_path, *minute(sentence("HETHS,50.0,V"), sentence("HEHDT,51.0,T")))
    np.testing.assert_allclose(dead["psi"].value, np.radians(51))
    assert "60 THS that is not autonomous skipped" in dead.notes
    compass = read(tmp_path, *minute(sentence("HCHDG,50.0,1.0,E,3.0,W")))
    np.testing.assert_allclose(compass["psi"].value, np.radians(48))
    magnetic = read(tmp_path, *minute(sentence("HCHDG,50.0,,,,")))
    assert any("HDG without variation" in n for n in magnetic.notes)


def test_ten_headings_a_second_lie_between_the_fixes(tmp_path):
    lines = [sentence("HEHDT,1.0,T")]
    for k in range(30):
        lines += [gga(k), *(sentence(f"HEHDT,{10 + k + j / 10:.1f},T") for j in range(10))]
    psi = read(tmp_path, *lines)["psi"]
    np.testing.assert_allclose(psi.t, np.arange(300) / 10, atol=1e-9)
    np.testing.assert_allclose(np.degrees(psi.value), 10 + psi.t, atol=1e-9)


def test_a_receiver_without_a_fix_still_tells_the_time(tmp_path):
    lines = [
        x
        for k in range(60)
        for x in (gga(k, fix=0 if 20 <= k < 40 else 1), sentence(f"HEHDT,{k}.0,T"))
    ]
    recording = read(tmp_path, *lines)
    np.testing.assert_allclose(recording["psi"].t, np.arange(60))
    assert len(recording["lat"]) == 40
    assert "20 GGA without a fix skipped" in recording.notes


def test_headings_go_on_at_their_rate_where_times_are_missing(tmp_path):
    lines = []
    for k in range(60):
        lines += [gga(k)] * (not 20 <= k < 40)
        lines += [sentence(f"HEHDT,{k}.{j}0,T") for j in range(0, 10, 2)]
    psi = read(tmp_path, *lines)["psi"]
    np.testing.assert_allclose(psi.t, np.arange(300) / 5, atol=1e-9)
    stopped = [x for k in range(60) if not 20 <= k < 40
               for x in (gga(k), *(sentence(f"HEHDT,{k}.0,T") for _ in range(5)))]  # fmt: skip
    psi = read(tmp_path, *stopped)["psi"]
    assert np.diff(psi.t).max() == pytest.approx(20.2)


def test_midnight(tmp_path):
    lines = []
    for k in range(86390, 86410):
        date = "310524" if k < 86400 else "010624"
        # the fix comes before the date of the new day
        lines += [gga(k), rmc(k, date), sentence("HEHDT,10.0,T")]
    recording = read(tmp_path, *lines)
    np.testing.assert_allclose(recording["psi"].t, np.arange(20))
    np.testing.assert_allclose(recording["lat"].t, np.arange(20))
    assert recording.epoch == 1717113600 + 86390


def test_a_pause_after_midnight_is_no_late_sentence(tmp_path):
    fixes = [86390, 86391, 87000, 86400 + 46800, 86400 + 46801]
    lines = [gga(k) + rmc(k, "310524" if k < 86400 else "010624") for k in fixes]
    recording = read(tmp_path, *lines)
    np.testing.assert_allclose(recording["lat"].t, np.subtract(fixes, fixes[0]))
    assert recording.epoch == 1717113600 + fixes[0]
    # a sentence that comes two seconds late belongs to the day before
    late = [rmc(k, "310524" if k < 86400 else "010624") for k in (86398, 86400, 86399, 86401)]
    np.testing.assert_allclose(np.sort(read(tmp_path, *late)["lat"].t), [0, 1, 2, 3])


def test_a_sure_date_tells_a_pause_of_nearly_a_day(tmp_path):
    fixes = [86390, 86400, 86401, 2 * 86400 - 5]
    lines = [rmc(k, "310524" if k < 86400 else "010624") for k in fixes]
    t = read(tmp_path, *lines)["lat"].t
    np.testing.assert_allclose(t, np.subtract(fixes, fixes[0]))


def test_two_days_in_one_file(tmp_path):
    lines = [rmc(36000 + k, "010624") for k in range(9)] + [
        rmc(30000 + k, "030624") for k in range(9)
    ]
    t = read(tmp_path, *lines)["lat"].t
    assert t[9] - t[8] == 2 * 86400 - 6000 - 8


def test_several_talkers(tmp_path):
    other = gga(0).replace("GPGGA", "GLGGA")
    lines = [x for k in range(40) for x in (gga(k), rmc(k))]
    lines[10] = sentence(other[1 : other.index("*")].replace("6325", "6400"))
    recording = read(tmp_path, *lines)
    assert np.ptp(recording["lat"].value) == 0
    assert "lat from $GPGGA" in " ".join(recording.notes).replace("from GPGGA", "from $GPGGA")


STAMPS = {
    "iso": lambda s: f"2024-06-01T{s // 3600:02.0f}:{s // 60 % 60:02.0f}:{s % 60:06.3f}Z ",
    "unix": lambda s: f"[{1717200000 + s:.3f}] ",
    "ms": lambda s: f"{(1717200000 + s) * 1000:.0f},",
    "tag block": lambda s: f"\\s:GPS,c:{1717200000 + s:.0f}*00\\",
}


@pytest.mark.parametrize("how", STAMPS)
def test_stamps_before_the_sentences(tmp_path, how):
    step = 1 if how == "tag block" else 0.1
    lines = [STAMPS[how](36000 + k * step) + sentence(f"HEHDT,{k % 360}.0,T") for k in range(100)]
    recording = read(tmp_path, *lines)
    np.testing.assert_allclose(recording["psi"].t, np.arange(100) * step, atol=1e-6)
    assert recording.epoch == pytest.approx(1717236000)


def test_stamps_beside_times_of_a_receiver(tmp_path):
    lines = []
    for k in range(40):
        lines.append(f"{1717236000 + k + 0.5:.3f} " + rmc(36000 + k))
        lines += [f"{1717236000.6 + k + j / 5:.3f} " + sentence("HEHDT,9.0,T") for j in range(4)]
    recording = read(tmp_path, *lines)
    # the logger's clock is half a second late: the receiver's is the one that counts
    np.testing.assert_allclose(recording["psi"].t[:4], [0.1, 0.3, 0.5, 0.7], atol=1e-6)
    assert recording.epoch == pytest.approx(1717236000)


def test_damage_is_counted_and_the_rest_read(tmp_path):
    lines = minute(sentence("HEHDT,10.0,T"))
    lines[3] = lines[3].replace("6325", "6335")
    lines[6] = lines[6][:20] + "\r\n"
    lines[9] = lines[9].strip() + lines[10]
    lines[10] = ""
    lines[12] = lines[12][:15] + lines[13]
    lines[13] = "\xff\x00\x80 garbage\n"
    lines[20] = sentence("HEHDT,nan,T")
    lines[23] = sentence("HEHDT,,T")
    lines[26] = sentence("HEHDT")
    lines[30] = sentence("GPGGA,306199.00,6325.5,N,01024.25,E,1,9,1,5,M,4,M,,")
    lines[33] = sentence("GPGGA,100010.00,9125.5,N,01024.25,E,1,9,1,5,M,4,M,,")
    lines[36] = sentence("GPGGA,100010.00,6325.5,X,01024.25,E,1,9,1,5,M,4,M,,")
    lines[40] = "!AIVDM,1,1,,A,15M67FC000G?ufbE`FepT@3n00Sa,0*5C\r\n"
    recording = read(tmp_path, *lines, "$GPGGA,10005")
    notes = " | ".join(recording.notes)
    assert "1 wrong checksums" in notes
    assert "3 truncated sentences" in notes
    assert "1 lines without a sentence" in notes
    assert "3 GPGGA with empty or wrong fields" in notes
    assert "3 HEHDT with empty or wrong fields" in notes
    assert np.ptp(recording["lat"].value) == 0
    # both sentences of a line that lost its end are read
    assert len(recording["lat"]) == 60 - 6


@pytest.mark.parametrize("end", ["\r\n", "\n", "\r"])
def test_ends_of_lines(tmp_path, end):
    lines = [x.replace("\r\n", end) for x in minute(sentence("HEHDT,10.0,T"))]
    assert len(read(tmp_path, *lines)["psi"]) == 60


@pytest.mark.parametrize(
    ("date", "year"), [("060199", 1999), ("060180", 1980), ("060179", 2079), ("060126", 2026)]
)
def test_years_of_two_digits_begin_with_gps(tmp_path, date, year):
    epoch = read(tmp_path, *[rmc(k, date) for k in range(3)]).epoch
    assert datetime.fromtimestamp(epoch, UTC).year == year


def test_proprietary_sentences_are_not_read_as_standard_ones(tmp_path):
    lines = minute(sentence("HEHDT,50.0,T"), sentence("PFHDT,12"))
    recording = read(tmp_path, *lines, *[sentence("PGRMC,A,218.8,100,6378137.000")] * 5)
    np.testing.assert_allclose(recording["psi"].value, np.radians(50))
    assert recording["psi"].source == "$HEHDT"
    assert "65 proprietary sentences skipped" in recording.notes
    assert not any("PGRMC" in n for n in recording.notes)
    only = read(tmp_path, *minute(sentence("PFHDT,12")))
    assert "psi" not in only


def test_a_sentence_gives_all_its_values_or_none(tmp_path):
    recording = read(
        tmp_path,
        *minute(sentence("WIMWV,30.0,R,7.5,N,A")),
        *minute(sentence("WIMWV,30.0,R,x,N,A"), start=36060),
    )
    assert len(recording["dir_q"]) == len(recording["V_q"]) == 60
    assert "60 WIMWV with empty or wrong fields skipped" in recording.notes


@pytest.mark.parametrize("tail", ["", ",100000", ",100000,A"])
def test_positions_of_every_version_of_gll(tmp_path, tail):
    lines = [x for k in range(9) for x in (sentence(f"GPZDA,{clock(36000 + k)},01,06,2024,00,00"),
             sentence(f"GPGLL,6325.5,N,01024.25,E{tail}"))]  # fmt: skip
    assert len(read(tmp_path, *lines)["lat"]) > 0


def test_a_status_that_warns(tmp_path):
    recording = read(tmp_path, *[rmc(k) for k in range(9)], *[rmc(9 + k, status="V")
                                                            for k in range(5)])  # fmt: skip
    assert len(recording["lat"]) == 9
    assert "5 RMC without a fix skipped" in recording.notes


def test_shafts_and_rudders_go_to_the_vessels_columns(tmp_path):
    twin = vessel_from_dict(
        {
            "name": "S",
            "length": 5,
            "thruster": [
                {"type": "propeller_rudder", "speed": f"n{k}", "rudder": f"d{k}", "y": k}
                for k in (1, 2)
            ],
        }
    )
    lines = minute(
        *(sentence(f"IIRPM,{kind},{k},{100 * k},,A") for kind in "SE" for k in (1, 2)),
        sentence("AGRSA,3.0,A,4.0,A"),
    )
    path = tmp_path / "x.nmea"
    path.write_text("".join(lines))
    recording = read_recording(path, twin)
    assert recording["n2"].value[0] == 200
    np.testing.assert_allclose(recording["d2"].value, np.radians(4))
    assert "rpm_shaft1 taken for n1 in rpm" in recording.notes
    azimuth = vessel_from_dict(
        {"name": "S", "length": 5, "thruster": [{"type": "azimuth", "speed": "n", "angle": "a"}]}
    )
    assert "a" not in read_recording(path, azimuth)
    led = vessel_from_dict(
        {"name": "S", "length": 5, "thruster": [
            {"type": "propeller_rudder", "speed": f"n{k}", "rudder": f"d{k}", "y": k,
             "speed_command": f"n{k}_ref", "rudder_command": f"d{k}_ref", "drive": "command"}
            for k in (1, 2)]}
    )  # fmt: skip
    names = read_recording(path, led).names
    assert {"n1", "n2", "d1", "d2"} <= set(names)
    assert not any(n.endswith("_ref") for n in names)


def test_numbers_that_no_shaft_has_are_damage(tmp_path):
    lines = minute(*(sentence(f"IIRPM,S,{k},10,,A") for k in (1, 100, -1, 10**20)))
    recording = read(tmp_path, *lines)
    assert [n for n in recording.names if "rpm" in n] == ["rpm_shaft1"]
    assert "180 IIRPM with empty or wrong fields skipped" in recording.notes


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("nothing here\n" * 9, "holds no NMEA 0183 sentence that can be read among 9 lines"),
        (sentence("HEHDT,10.0,T") * 9, "9 sentences but none with a time"),
        (sentence("HEHDT,10.0,T") + sentence("GPZDA,100000,01,06,2024,00,00"), "no value"),
        ("$GPGGA,1,2\n" * 5, "none with a time|no NMEA"),
    ],
)
def test_bad_nmea(tmp_path, content, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, content)


def test_a_line_without_end_takes_no_memory(tmp_path):
    path = tmp_path / "x.nmea"
    path.write_text("".join(minute()))
    with open(path, "ab") as handle:
        handle.truncate(64 * 2**20)
    assert len(read_nmea(path)["lat"]) == 60


def test_noisy_headings_keep_their_statistics(tmp_path):
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.5, 2000)
    lines = [
        x
        for k in range(200)
        for x in (gga(k), *(sentence(f"HEHDT,{90 + e:.3f},T") for e in noise[10 * k : 10 * k + 10]))
    ]
    psi = np.degrees(read(tmp_path, *lines)["psi"].value)
    assert abs(psi.mean() - 90) < 4 * 0.5 / np.sqrt(2000)
    np.testing.assert_allclose(psi.std(), noise.std(), rtol=1e-3)
