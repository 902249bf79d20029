// CANopen master that shares no code with armrig: gocanopen, over the CAN hub, against an emulated drive.
//
// Usage: master HOST:PORT NODE EDS
//
// Prints one line per check, "ok NAME: what was seen" or "FAILED NAME: why", and stops at the first failure.
package main

import (
	"errors"
	"fmt"
	"io"
	"log/slog"
	"os"
	"slices"
	"strconv"
	"sync"
	"time"

	canopen "github.com/samsamfire/gocanopen"
	_ "github.com/samsamfire/gocanopen/pkg/can/virtual"
	"github.com/samsamfire/gocanopen/pkg/config"
	"github.com/samsamfire/gocanopen/pkg/network"
	"github.com/samsamfire/gocanopen/pkg/nmt"
	"github.com/samsamfire/gocanopen/pkg/sdo"
)

const (
	tpdo1    = 512 + 1 // gocanopen numbers TPDOs after 512 RPDOs
	tpdo3    = 512 + 3
	patience = 2 * time.Second
)

// heard collects the frames of one COB-ID.
type heard struct {
	mu     sync.Mutex
	frames []canopen.Frame
}

func (h *heard) Handle(frame canopen.Frame) {
	h.mu.Lock()
	defer h.mu.Unlock()
	h.frames = append(h.frames, frame)
}

func (h *heard) all() []canopen.Frame {
	h.mu.Lock()
	defer h.mu.Unlock()
	return slices.Clone(h.frames)
}

func (h *heard) forget() {
	h.mu.Lock()
	defer h.mu.Unlock()
	h.frames = nil
}

// eventually waits for a condition with a deadline.
func eventually(condition func() bool) bool {
	for end := time.Now().Add(patience); time.Now().Before(end); time.Sleep(time.Millisecond) {
		if condition() {
			return true
		}
	}
	return condition()
}

type master struct {
	net  *network.Network
	id   uint8
	eds  string
	conf *config.NodeConfigurator
}

func (m *master) listen(cobID uint32) (*heard, error) {
	listener := &heard{}
	return listener, m.net.Subscribe(cobID, 0x7FF, false, listener)
}

func (m *master) syncs(count int, period time.Duration) error {
	for range count {
		if err := m.net.Send(canopen.NewFrame(0x80, 0, 0)); err != nil {
			return err
		}
		time.Sleep(period)
	}
	return nil
}

func (m *master) scan() (string, error) {
	found, err := m.net.Scan(500)
	if err != nil {
		return "", err
	}
	ids := make([]int, 0, len(found))
	for id := range found {
		ids = append(ids, int(id))
	}
	slices.Sort(ids)
	if !slices.Contains(ids, int(m.id)) {
		return "", fmt.Errorf("node %d is not among %v", m.id, ids)
	}
	return fmt.Sprint(ids), nil
}

func (m *master) identity() (string, error) {
	identity, err := m.conf.ReadIdentity()
	if err != nil {
		return "", err
	}
	name, err := m.conf.ReadManufacturerDeviceName() // 18 characters: a segmented upload
	return fmt.Sprintf("product %08X %q", identity.ProductCode, name), err
}

func (m *master) aborts() (string, error) {
	_, missing := m.net.ReadUint32(m.id, 0x2FFF, 0)
	_, sub := m.net.ReadUint32(m.id, 0x1018, 9)
	constant := m.net.WriteRaw(m.id, 0x1000, 0, uint32(1), false)
	long := m.net.WriteRaw(m.id, 0x6040, 0, uint32(1), false)
	for _, pair := range []struct{ got, want error }{
		{missing, sdo.AbortNotExist}, {sub, sdo.AbortSubUnknown},
		{constant, sdo.AbortReadOnly}, {long, sdo.AbortDataLong},
	} {
		if !errors.Is(pair.got, pair.want) {
			return "", fmt.Errorf("expected %v, got %v", pair.want, pair.got)
		}
	}
	return "no object, no sub-index, read only, too long", nil
}

func (m *master) heartbeat() (string, error) {
	beats, err := m.listen(0x700 + uint32(m.id))
	if err != nil {
		return "", err
	}
	if err := m.conf.WriteHeartbeatPeriod(20); err != nil {
		return "", err
	}
	period, err := m.conf.ReadHeartbeatPeriod()
	if err != nil {
		return "", err
	}
	if !eventually(func() bool { return len(beats.all()) >= 5 }) {
		return "", fmt.Errorf("%d heartbeats in %v", len(beats.all()), patience)
	}
	return fmt.Sprintf("every %d ms", period), m.conf.WriteHeartbeatPeriod(0)
}

func (m *master) readPDO() (string, error) {
	conf, err := m.conf.ReadConfigurationPDO(tpdo1)
	if err != nil {
		return "", err
	}
	text := fmt.Sprintf("%03X type %d", conf.CanId, conf.TransmissionType)
	for _, entry := range conf.Mappings {
		text += fmt.Sprintf(" %04X:%d/%d", entry.Index, entry.Subindex, entry.LengthBits)
	}
	return text, nil
}

func (m *master) configurePDO() (string, error) {
	if err := m.conf.DisablePDO(tpdo3); err != nil {
		return "", err
	}
	wanted := config.PDOConfigurationParameter{
		CanId:            0x380 + uint16(m.id),
		TransmissionType: 2, // every second SYNC
		Mappings:         []config.PDOMappingParameter{{Index: 0x6041, LengthBits: 16}, {Index: 0x6064, LengthBits: 32}},
	}
	if err := m.conf.WriteConfigurationPDO(tpdo3, wanted); err != nil {
		return "", err
	}
	if err := m.conf.EnablePDO(tpdo3); err != nil {
		return "", err
	}
	enabled, err := m.conf.ReadEnabledPDO(tpdo3)
	if err != nil {
		return "", err
	}
	got, err := m.conf.ReadConfigurationPDO(tpdo3)
	if err != nil {
		return "", err
	}
	if !enabled || got.CanId != wanted.CanId || got.TransmissionType != 2 || !slices.Equal(got.Mappings, wanted.Mappings) {
		return "", fmt.Errorf("read back %+v, enabled %v", got, enabled)
	}
	return fmt.Sprintf("%03X type 2, 2 objects", got.CanId), nil
}

func (m *master) syncPDOs() (string, error) {
	first, err := m.listen(0x180 + uint32(m.id))
	if err != nil {
		return "", err
	}
	third, err := m.listen(0x380 + uint32(m.id))
	if err != nil {
		return "", err
	}
	if err := m.syncs(10, 2*time.Millisecond); err != nil { // PRE-OPERATIONAL: no PDO may answer
		return "", err
	}
	if len(first.all())+len(third.all()) > 0 {
		return "", errors.New("PDOs before OPERATIONAL")
	}
	if err := m.net.Command(m.id, nmt.CommandEnterOperational); err != nil {
		return "", err
	}
	first.forget()
	if err := m.syncs(10, 2*time.Millisecond); err != nil {
		return "", err
	}
	eventually(func() bool { return len(first.all()) >= 10 })
	if err := m.conf.DisablePDO(tpdo3); err != nil {
		return "", err
	}
	seen := len(third.all())
	if err := m.syncs(10, 2*time.Millisecond); err != nil {
		return "", err
	}
	eventually(func() bool { return len(first.all()) >= 20 })
	text := fmt.Sprintf("20 SYNCs: TPDO1 %d, TPDO3 %d then %d", len(first.all()), seen, len(third.all())-seen)
	if len(first.all()) != 20 || seen != 5 || len(third.all()) != 5 {
		return "", errors.New(text)
	}
	return text, nil
}

func (m *master) dataSheet() (string, error) {
	node, err := m.net.AddRemoteNode(m.id, m.eds)
	if err != nil {
		return "", err
	}
	if err := node.StartPDOs(false); err != nil {
		return "", err
	}
	modes, err := m.net.ReadUint32(m.id, 0x6502, 0)
	if err != nil {
		return "", err
	}
	text := fmt.Sprintf("%d objects, supported modes %08X", len(node.GetOD().Entries()), modes)
	return text, m.net.RemoveNode(m.id) // it would go on sending RPDOs
}

// walk goes through the CiA 402 states while SYNC keeps running, in position mode at the present position.
func (m *master) walk() (string, error) {
	stop, stopped := make(chan struct{}), make(chan struct{})
	go func() {
		defer close(stopped)
		for {
			select {
			case <-stop:
				return
			default:
				_ = m.syncs(1, 5*time.Millisecond)
			}
		}
	}()
	defer func() { close(stop); <-stopped }()
	position, err := m.net.ReadUint32(m.id, 0x6064, 0)
	if err != nil {
		return "", err
	}
	if err := m.net.WriteRaw(m.id, 0x607A, 0, position, false); err != nil {
		return "", err
	}
	if err := m.net.WriteRaw(m.id, 0x6060, 0, int8(8), false); err != nil {
		return "", err
	}
	text := ""
	for _, step := range []struct{ control, status uint16 }{
		{0x0000, 0x0240}, {0x0006, 0x0231}, {0x0007, 0x0233}, {0x000F, 0x0237},
		{0x0007, 0x0233}, {0x0006, 0x0231}, {0x0000, 0x0240},
	} {
		if err := m.net.WriteRaw(m.id, 0x6040, 0, step.control, false); err != nil {
			return "", err
		}
		var status uint16
		reached := eventually(func() bool {
			status, err = m.net.ReadUint16(m.id, 0x6041, 0)
			return err == nil && status&0x027F == step.status // states, voltage, quick stop, remote
		})
		if !reached {
			return "", fmt.Errorf("controlword %04X gives statusword %04X, not %04X (%v)",
				step.control, status, step.status, err)
		}
		text += fmt.Sprintf(" %04X", step.status)
	}
	return text[1:], nil
}

func (m *master) reset() (string, error) {
	beats, err := m.listen(0x700 + uint32(m.id))
	if err != nil {
		return "", err
	}
	if err := m.net.Command(m.id, nmt.CommandResetNode); err != nil {
		return "", err
	}
	if !eventually(func() bool { return len(beats.all()) > 0 }) {
		return "", errors.New("no boot-up")
	}
	conf, err := m.conf.ReadNbMappings(tpdo3)
	if err != nil {
		return "", err
	}
	if bootUp := beats.all(); len(bootUp) != 1 || bootUp[0].Data[0] != 0 || conf != 0 {
		return "", fmt.Errorf("%d heartbeats, TPDO3 with %d objects", len(bootUp), conf)
	}
	return "one boot-up, defaults restored", nil
}

func (m *master) stopped() (string, error) {
	// A client of its own: after a timeout, an SDO client of gocanopen 1.4.4 aborts every further upload at once.
	client, err := sdo.NewSDOClient(m.net.BusManager, slog.Default(), nil, 0, 200, nil)
	if err != nil {
		return "", err
	}
	if err := m.net.Command(m.id, nmt.CommandEnterStopped); err != nil {
		return "", err
	}
	if _, err := client.ReadUint16(m.id, 0x6041, 0); !errors.Is(err, sdo.AbortTimeout) {
		return "", fmt.Errorf("an SDO in STOPPED gave %v instead of silence", err)
	}
	if err := m.net.Command(m.id, nmt.CommandEnterPreOperational); err != nil {
		return "", err
	}
	status, err := m.net.ReadUint16(m.id, 0x6041, 0)
	return fmt.Sprintf("silence, then statusword %04X", status), err
}

func run() error {
	if len(os.Args) != 4 {
		return errors.New("usage: master HOST:PORT NODE EDS")
	}
	id, err := strconv.ParseUint(os.Args[2], 10, 7)
	if err != nil {
		return err
	}
	slog.SetDefault(slog.New(slog.NewTextHandler(io.Discard, nil)))
	net := network.NewNetwork(nil)
	if err := net.Connect("virtualcan", os.Args[1], 1_000_000); err != nil {
		return err
	}
	defer net.Disconnect()
	m := &master{net: &net, id: uint8(id), eds: os.Args[3], conf: net.Configurator(uint8(id))}
	for _, check := range []struct {
		name string
		run  func() (string, error)
	}{
		{"scan", m.scan}, {"identity", m.identity}, {"aborts", m.aborts}, {"heartbeat", m.heartbeat},
		{"read PDO", m.readPDO}, {"configure PDO", m.configurePDO}, {"PDOs on SYNC", m.syncPDOs},
		{"data sheet", m.dataSheet}, {"CiA 402", m.walk}, {"reset", m.reset}, {"stopped", m.stopped},
	} {
		seen, err := check.run()
		if err != nil {
			return fmt.Errorf("FAILED %s: %w", check.name, err)
		}
		fmt.Printf("ok %s: %s\n", check.name, seen)
	}
	return nil
}

func main() {
	if err := run(); err != nil {
		fmt.Println(err)
		os.Exit(1)
	}
}
