// Reads MQTT payloads as Telegraf's parser json_v2 does, with the same library for its paths: gjson.
//
// Standard input has JSON lines {"json_v2": [...], "payload": "..."}; each gives a line with its metrics, or an error.
// It follows the documented behaviour: arrays make a metric of each element, objects one of all their keys, nested keys
// are joined by _, null is left out, and an object without keys drops the keys before it.
package main

import (
	"bufio"
	"encoding/json"
	"fmt"
	"os"
	"strings"

	"github.com/tidwall/gjson"
)

type dataSet struct {
	Path, Rename string
	Optional     bool
}

type config struct {
	MeasurementName string `json:"measurement_name"`
	TimestampPath   string `json:"timestamp_path"`
	TimestampFormat string `json:"timestamp_format"`
	Field, Tag      []dataSet
	Object          []struct {
		Path string
		Tags []string
	}
}

type metric struct {
	Name   string                 `json:"name"`
	Time   string                 `json:"time"`
	Tags   map[string]string      `json:"tags"`
	Fields map[string]interface{} `json:"fields"`
}

func empty(from metric) metric {
	return metric{from.Name, from.Time, map[string]string{}, map[string]interface{}{}}
}

func merged(metrics ...metric) metric {
	all := empty(metrics[0])
	for _, one := range metrics {
		for key, value := range one.Tags {
			all.Tags[key] = value
		}
		for key, value := range one.Fields {
			all.Fields[key] = value
		}
	}
	return all
}

func product(left, right []metric) (all []metric) {
	if len(left) == 0 {
		return right
	}
	if len(right) == 0 {
		return left
	}
	for _, one := range left {
		for _, other := range right {
			all = append(all, merged(one, other))
		}
	}
	return all
}

// add puts a single value into a metric: of a number as a tag fmt.Sprint, of null nothing.
func add(to metric, key string, value gjson.Result, tag bool) {
	switch {
	case value.Type == gjson.Null:
	case tag:
		to.Tags[key] = fmt.Sprint(value.Value())
	default:
		to.Fields[key] = value.Value()
	}
}

func expanded(value gjson.Result, key string, tags []string, into metric) (all []metric) {
	switch {
	case value.IsObject():
		return combined(value, key, tags, into)
	case value.IsArray():
		for _, element := range value.Array() {
			all = append(all, expanded(element, key, tags, merged(into))...)
		}
		return all
	}
	tag := false
	for _, name := range tags {
		tag = tag || name == key
	}
	add(into, key, value, tag)
	return []metric{into}
}

func combined(object gjson.Result, prefix string, tags []string, into metric) (all []metric) {
	object.ForEach(func(key, value gjson.Result) bool {
		name := key.String()
		if prefix != "" {
			name = prefix + "_" + name
		}
		if value.IsObject() {
			all = combined(value, name, tags, into)
		} else {
			all = product(expanded(value, name, tags, into), all)
		}
		return true
	})
	return all
}

func single(payload string, sets []dataSet, tag bool, like metric) (all []metric, err error) {
	for _, set := range sets {
		value := gjson.Get(payload, set.Path)
		if !value.Exists() && !set.Optional {
			return nil, fmt.Errorf("no %s", set.Path)
		}
		name := set.Rename
		if name == "" {
			name = set.Path[strings.LastIndex(set.Path, ".")+1:]
		}
		one := empty(like)
		add(one, name, value, tag)
		all = product(all, []metric{one})
	}
	return all, nil
}

func parsed(payload string, configs []config) (all []metric, err error) {
	if !gjson.Valid(payload) {
		return nil, fmt.Errorf("not JSON")
	}
	for _, config := range configs {
		like := metric{Name: config.MeasurementName}
		if config.TimestampPath != "" {
			if like.Time = gjson.Get(payload, config.TimestampPath).String(); like.Time == "" || config.TimestampFormat != "unix_ns" {
				return nil, fmt.Errorf("no time at %s", config.TimestampPath)
			}
		}
		fields, err := single(payload, config.Field, false, like)
		if err != nil {
			return nil, err
		}
		tags, err := single(payload, config.Tag, true, like)
		if err != nil {
			return nil, err
		}
		var objects []metric
		for _, object := range config.Object {
			value := gjson.Get(payload, object.Path)
			if !value.Exists() {
				return nil, fmt.Errorf("no %s", object.Path)
			}
			objects = append(objects, expanded(value, "", object.Tags, empty(like))...)
		}
		all = append(all, product(objects, product(tags, fields))...)
	}
	return all, nil
}

func main() {
	input := bufio.NewScanner(os.Stdin)
	input.Buffer(nil, 1<<24)
	output := json.NewEncoder(os.Stdout)
	for input.Scan() {
		var line struct {
			Configs []config `json:"json_v2"`
			Payload string
		}
		if err := json.Unmarshal(input.Bytes(), &line); err != nil {
			panic(err)
		}
		metrics, err := parsed(line.Payload, line.Configs)
		if err != nil {
			output.Encode(map[string]string{"error": err.Error()})
		} else {
			output.Encode(metrics)
		}
	}
}
