#!/bin/sh
# Installs the valve board on a Raspberry Pi OS (bookworm or later). Run as root, from the
# folder that `python3 -m sorojax_board --installer` names.
set -eu
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)

apt-get install -y python3-smbus2
raspi-config nonint do_i2c 0
# five more buses, so that boards with equal addresses do not clash
config=/boot/firmware/config.txt
for bus in 3 4 5 6; do
    grep -q "^dtoverlay=i2c$bus" "$config" || echo "dtoverlay=i2c$bus,baudrate=400000" >>"$config"
done
grep -q 'bus=7' "$config" || echo 'dtoverlay=i2c-gpio,bus=7,i2c_gpio_delay_us=1' >>"$config"
grep -q '^dtparam=i2c_arm_baudrate' "$config" || echo 'dtparam=i2c_arm_baudrate=400000' >>"$config"

id sorojax-board >/dev/null 2>&1 || useradd --system --no-create-home sorojax-board
install -d /opt/sorojax-board /etc/sorojax-board
cp -r "${here%/*}" /opt/sorojax-board/
if [ ! -e /etc/sorojax-board/key ]; then
    PYTHONPATH=/opt/sorojax-board python3 -m sorojax_board --new-key /etc/sorojax-board/key
fi
if [ ! -e /etc/sorojax-board/board.json ]; then
    install -m 0644 "$here/board.json" /etc/sorojax-board/board.json
fi
chown -R sorojax-board /etc/sorojax-board
install -m 0644 "$here/sorojax-board.service" /etc/systemd/system/
systemctl daemon-reload
systemctl enable sorojax-board
echo "Copy /etc/sorojax-board/key to the workstation (mode 0600), edit board.json, and reboot."
