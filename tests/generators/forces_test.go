package messages

import (
	"encoding/json"
	"os"
	"testing"
)

// TestUnknownForceIsNil reads a message of `forces` whose force is null.
func TestUnknownForceIsNil(t *testing.T) {
	text, err := os.ReadFile("overload.json")
	if err != nil {
		t.Fatal(err)
	}
	var forces Forces
	if err := json.Unmarshal(text, &forces); err != nil {
		t.Fatal(err)
	}
	site := forces.Sites[0]
	if site.ForceNewton != nil || site.AtLeastNewton == nil || *site.AtLeastNewton != 10.0 {
		t.Errorf("force %v, at least %v", site.ForceNewton, site.AtLeastNewton)
	}
	if *site.Status != StatusOverload {
		t.Errorf("status %v", site.Status.Value())
	}
}

// TestExamplesKeepTheirValues reads each example and writes what its type has kept of it.
func TestExamplesKeepTheirValues(t *testing.T) {
	text, err := os.ReadFile("examples.json")
	if err != nil {
		t.Fatal(err)
	}
	var examples map[string][]json.RawMessage
	if err := json.Unmarshal(text, &examples); err != nil {
		t.Fatal(err)
	}
	kept := map[string][]any{}
	for name, payloads := range examples {
		for _, payload := range payloads {
			message := newMessage(name)
			if err := json.Unmarshal(payload, message); err != nil {
				t.Errorf("%s: %v", name, err)
			}
			kept[name] = append(kept[name], message)
		}
	}
	text, err = json.Marshal(kept)
	if err != nil {
		t.Fatal(err)
	}
	if err := os.WriteFile("kept.json", text, 0o644); err != nil {
		t.Fatal(err)
	}
}
